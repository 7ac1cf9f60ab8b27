"""What a benchmark leaves: scores, tables, pictures, reports and pages. It knows nothing of commands."""
