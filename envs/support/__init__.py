"""What all folders share and no physics needs: errors, files, plug-ins, handles of C++ libraries."""
