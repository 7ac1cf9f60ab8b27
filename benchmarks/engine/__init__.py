"""What runs a benchmark: methods, their amounts, and jobs. It knows nothing of its output."""
