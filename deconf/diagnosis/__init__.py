"""Is data confounded? From expert trials and exploration alone."""
