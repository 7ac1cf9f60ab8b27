"""Commands that measure: run, certify, speed."""
