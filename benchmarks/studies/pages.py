"""Write the pages of docs/ and README's tables anew, from what is kept in docs/: `deconf pages`

With --still also docs/index.png, README's picture of docs/index.html; that takes Chromium.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

from deconfounded.benchmarks.console import Parser, run_command
from deconfounded.benchmarks.studies import site
from deconfounded.benchmarks.studies.browser import Browser
from deconfounded.envs.support.files import write_atomically


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--still", action="store_true", help="docs/index.png too, by Chromium")
    still = parser.parse_args().still
    table = site.write()
    if still:
        with Browser(1280, 960) as browser:
            browser.open(site.DOCS / "index.html")
            write_atomically(site.DOCS / "index.png", browser.picture())
    print(table)


if __name__ == "__main__":
    run_command(main)
