"""Write the pages of docs/ and README's tables anew, from what is kept in docs/: `python benchmarks/pages.py`"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from deconfounded.benchmarks.console import Parser, run_command
from deconfounded.benchmarks.output import pages


def main() -> None:
    """The command line."""
    Parser(__doc__).parse_args()
    pages.write()
    print(pages.summary())


if __name__ == "__main__":
    run_command(main)
