"""Where fetched data lie, and how a study gets at them.

The cache folder holds one folder an entry, each with a manifest that says which entry of the table it came
from.  A folder appears by one rename, complete or not at all.
"""

import json
import os
from fnmatch import fnmatchcase
from pathlib import Path

import platformdirs

from experiments.data.table import TABLE, Entry

MANIFEST = ".manifest.json"


def root() -> Path:
    """Return the cache folder: ``APMODELS_DATA`` if it is set, the user's own cache otherwise."""
    named = os.environ.get("APMODELS_DATA")
    return Path(named).expanduser().absolute() if named else Path(platformdirs.user_cache_dir("apmodels"))


def folder(name: str) -> Path:
    """Return the folder of a fetched entry.

    Raises ``FileNotFoundError`` if it has not been fetched, or was by an older table, and ``ValueError``
    if the table has no such entry.
    """
    entry = find(name)
    if not is_current(entry):
        raise FileNotFoundError(
            f"the data {name!r} ({entry.source}) have not been fetched into {root()}: {_advice(entry)}"
        )
    return root() / name


def files(name: str, pattern: str = "**/*") -> list[Path]:
    """Return the files of a fetched entry that match ``pattern``, sorted; see :func:`folder` for errors."""
    found = (path for path in folder(name).glob(pattern) if path.is_file() and path.name != MANIFEST)
    return sorted(found, key=lambda path: path.as_posix())


def scenes() -> list[Path]:
    """Return the photographs without people of every entry that has been fetched, sorted within an entry."""
    chosen = []
    for name in available():
        place, patterns = folder(name), TABLE[name].scenes
        for path in files(name):
            inside = path.relative_to(place).as_posix()
            chosen += [path] if any(fnmatchcase(inside, pattern) for pattern in patterns) else []
    return chosen


def available() -> list[str]:
    """Return the names of the entries that have been fetched, in the order of the table."""
    return [name for name, entry in TABLE.items() if is_current(entry)]


def find(name: str) -> Entry:
    """Return the table's entry of that name, or raise ``ValueError`` with the names that there are."""
    if name not in TABLE:
        raise ValueError(f"there are no data named {name!r}; the names are {', '.join(TABLE)}")
    return TABLE[name]


def manifest(entry: Entry) -> dict | None:
    """Return what was written down when the entry was fetched, or None if it was not."""
    try:
        return json.loads((root() / entry.name / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def write_manifest(entry: Entry, folder: Path, **what: object) -> None:
    """Write into ``folder`` which entry it holds, and what came."""
    text = json.dumps({"entry": identity(entry), **what}, indent=1, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def identity(entry: Entry) -> list:
    """Return what decides the contents of an entry's folder: another identity is fetched anew."""
    return [entry.registry, entry.package, entry.version, entry.sha256, entry.root, list(entry.files)]


def is_current(entry: Entry) -> bool:
    """Say whether the entry has been fetched as the table has it now."""
    written = manifest(entry)
    return written is not None and written.get("entry") == identity(entry)


def is_whole(entry: Entry) -> bool:
    """Say whether the entry is current and each of its files is there at its full size."""
    written = manifest(entry)
    if written is None or written.get("entry") != identity(entry):
        return False
    return all(_size(root() / entry.name / path) == size for path, size in written["files"].items())


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else -1


def _advice(entry: Entry) -> str:
    return f"run `python -m experiments.data {entry.name}`" if entry.optional else "run `make data`"
