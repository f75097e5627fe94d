"""Fetching: download, verify, unpack into a temporary folder, rename.

Whatever stops a run, the cache holds whole entries only, and the next run goes on with the first that is not
there; an archive that had been downloaded and verified already is not downloaded again.
"""

import hashlib
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from experiments.data import archives, clients, store
from experiments.data.clients import Failed
from experiments.data.table import TABLE, Entry

try:
    import fcntl
except ImportError:  # Windows: two runs at the same time are not kept apart
    fcntl = None

PAUSE = 2.0  # seconds before the one retry
Say = Callable[[str], None]


def fetch(names: Iterable[str] | None = None, *, console: Console | None = None) -> dict[str, str]:
    """Fetch the named entries, or all that are not optional; return one sentence for each.

    A sentence starts with ``fetched``, ``present`` (nothing was downloaded), ``skipped`` (a client is not
    installed) or ``failed``.  One entry's failure does not stop the others.
    """
    wanted = [e for e in TABLE.values() if not e.optional] if names is None else [store.find(n) for n in names]
    console = console or Console(stderr=True)
    results: dict[str, str] = {}
    store.root().mkdir(parents=True, exist_ok=True)
    with _alone(console), _progress(console) as progress:
        task = progress.add_task("", total=len(wanted))
        for entry in wanted:
            results[entry.name] = _fetch_one(entry, lambda doing: progress.update(task, description=doing))
            progress.advance(task)
            line = f"{entry.name}: {results[entry.name]}"
            progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
    return results


def _fetch_one(entry: Entry, say: Say) -> str:
    if store.is_whole(entry):
        return f"present, {_contents(entry)}."
    reason = clients.missing(entry.registry)
    if reason:
        return f"skipped: {reason}"
    part = store.root() / ".partial" / entry.name
    try:
        lost = _install(entry, part, say)
    except Failed as problem:
        return f"failed: {problem}"
    except OSError as problem:
        return f"failed: {problem.filename or part} could not be read or written: {problem.strerror or problem}."
    without = f"; not in this version: {', '.join(lost)}" if lost else ""
    return f"fetched, {_contents(entry)}{without}."


def _install(entry: Entry, part: Path, say: Say) -> list[str]:
    """Put the entry into the cache; return the patterns of files that the package did not have."""
    try:
        archive = _verified_archive(entry, part / "archive", say)
        say(f"{entry.name}: unpacking")
        fresh = _empty(part / "files")
        kept = archives.unpack(archive, entry, fresh)
        store.write_manifest(entry, fresh, archive=archive.name, sha256=_sha256(archive), files=kept)
        _put(fresh, store.root() / entry.name)
    except (Failed, OSError):
        _remove(part)
        raise
    _remove(part)
    return archives.absent(entry, kept)


def _verified_archive(entry: Entry, folder: Path, say: Say) -> Path:
    """Return the archive that an interrupted run has left, if it is whole, or download it, trying twice."""
    for left in folder.glob("*"):
        if entry.sha256 and _sha256(left) == entry.sha256:
            return left
    try:
        return _download(entry, _empty(folder), say)
    except Failed:
        time.sleep(PAUSE)
        return _download(entry, _empty(folder), say)


def _download(entry: Entry, folder: Path, say: Say) -> Path:
    say(f"{entry.name}: downloading about {entry.megabytes} MB")
    archive = clients.download(entry, folder)
    say(f"{entry.name}: verifying")
    if entry.sha256 and _sha256(archive) != entry.sha256:
        raise Failed(f"the checksum of {archive.name} is not the one in the table; the file was thrown away.")
    return archive


def _put(fresh: Path, place: Path) -> None:
    """Move a finished folder to its place, in one step but for an older one that has to make room."""
    if place.exists():
        old = fresh.with_name("old")
        _remove(old)
        place.rename(old)
    fresh.rename(place)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _empty(folder: Path) -> Path:
    _remove(folder)
    folder.mkdir(parents=True)
    return folder


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


def _contents(entry: Entry) -> str:
    written = store.manifest(entry) or {"files": {}, "archive": "?"}
    sizes = written["files"].values()
    return f"{len(sizes)} file{'s' * (len(sizes) != 1)}, {sum(sizes) / 1e6:.1f} MB, from {written['archive']}"


@contextmanager
def _alone(console: Console) -> Iterator[None]:
    """Keep two runs on one cache folder apart: the second waits for the first."""
    with (store.root() / ".lock").open("w") as lock:
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                console.print("Another run is fetching into this folder; waiting for it.")
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield
        with suppress(OSError):  # not there, or an interrupted entry waits in it
            (store.root() / ".partial").rmdir()


def _progress(console: Console) -> Progress:
    columns = (SpinnerColumn(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    columns = (*columns, TextColumn("{task.description}", markup=False))
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
