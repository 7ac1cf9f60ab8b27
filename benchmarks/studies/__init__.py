"""Commands that make this repository's own pages: the table of records, pages, studies of cost, noise and tuning."""
