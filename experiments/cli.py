"""The one command: ``apmodels experiment=NAME key=value ...``, and tools by their first word."""

from __future__ import annotations

import os
import sys
import textwrap
import warnings
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from rich.console import Console

# First word -> (function, what it does). A tool takes the remaining words.
TOOLS: dict[str, tuple[str, str]] = {
    "contingency": ("experiments.contingency_listen:main", "was anybody answering, in a recording and its calls?"),
    "data": ("experiments.data.__main__:main", "fetch the real data that studies and tests use"),
    "head": ("experiments.head:main", "does each motor of a head move what its camera sees? (head check)"),
}
GROUPS = ("model", "engine", "controller", "body", "launcher")


def main() -> None:
    """Run an experiment, a sweep (-m), or a tool."""
    try:
        _main(sys.argv[1:])
    except KeyboardInterrupt:
        fail("interrupted", 130)


def _main(words: list[str]) -> None:
    if not words or (words[0] in ("-h", "--help") and len(words) == 1):
        print(usage())
        return
    if "=" not in words[0] and not words[0].startswith("-"):
        _run_tool(words[0], words[1:])
        return
    sweeping = "-m" in words or "--multirun" in words
    sys.argv[1:] = [_quoted(word, sweeping) for word in words]
    _hydra()


def _quoted(word: str, sweeping: bool = False) -> str:
    """Quote the value of key=PATH where a path exists: Hydra's grammar stumbles over brackets and the like.

    A photo is a path even if there is none, but for a sweep, which is a list of them.
    """
    key, _, value = word.partition("=")
    plain = all(c.isalnum() or c in "/._-" for c in value)
    is_path = (key == "photo" and not sweeping) or os.path.exists(os.path.expanduser(value))
    if not value or plain or value[0] in "'\"" or not is_path:
        return word
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"{key}='{escaped}'"


def usage() -> str:
    """Return what ``apmodels --help`` prints: experiments, tools and groups, a line each."""
    lines = ["Probabilistic active perception.", ""]
    lines += [
        "usage: apmodels experiment=NAME [key=value ...]",
        "       apmodels -m experiment=NAME key=a,b ...",
        "",
    ]
    lines += ["experiments"]
    lines += [f"  {name:<31} {about}" for name, about in choices("experiment").items()]
    lines += ["", "tools (apmodels NAME --help)"]
    lines += [f"  {name:<22} {about}" for name, (_, about) in TOOLS.items()]
    lines += ["", "groups (GROUP=NAME)"]
    for group in GROUPS:
        lines += textwrap.wrap(
            ", ".join(choices(group)), 116, initial_indent=f"  {group:<22} ", subsequent_indent=" " * 25
        )
    lines += ["", "Every run: seed=N, quick=true, hydra.run.dir=DIR. All of one experiment's keys:"]
    lines += ["  apmodels experiment=NAME --cfg job"]
    return "\n".join(lines)


def choices(group: str) -> dict[str, str]:
    """Return the choices of a configuration group and the first comment of each."""
    root = files("conf") / group
    found = {}
    for path in sorted(Path(str(root)).rglob("*.yaml")):
        name = path.relative_to(str(root)).with_suffix("").as_posix()
        comments = [line[2:].strip() for line in path.read_text().splitlines() if line.startswith("# ")]
        found[name] = next((c for c in comments if not c.startswith("@")), "")
    return found


def _run_tool(name: str, words: list[str]) -> None:
    if name not in TOOLS:
        fail(f"there is no tool {name}; the tools are {', '.join(TOOLS)}, and an experiment is experiment=NAME")
    module, function = TOOLS[name][0].split(":")
    sys.argv = [f"apmodels {name}", *words]
    sys.exit(getattr(import_module(module), function)())


def _hydra() -> None:
    import hydra
    from omegaconf import DictConfig

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name="config")
    def job(config: DictConfig) -> None:
        run(config)

    job()


def run(config: Any) -> None:
    """Run one configured study and write what it returns into Hydra's folder."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import InstantiationException
    from hydra.utils import get_method

    folder = Path(HydraConfig.get().runtime.output_dir)
    console = Console(highlight=False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category=FutureWarning)
            result = get_method(config.study)(config, folder, console)
        paths = result.write(folder)
    except InstantiationException as error:
        # The whole message quotes the cause, and names the class and the key.
        fail(str(error.__cause__ or error))
    except (ValueError, OSError, TypeError) as error:
        if not is_users(error):
            raise
        fail(str(error))
    for path in paths:
        console.print(f"wrote {_near(path)}", soft_wrap=True)


def fail(message: str, code: int = 2) -> None:
    """Say one sentence and leave."""
    print(f"apmodels: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


def is_users(error: BaseException) -> bool:
    """Whether an error speaks to a user; anything else is our mistake, and keeps its traceback."""
    from apmodels import DeclarationError, ValueOutOfRange
    from hardware import CameraError, MotorError, PhotoError, SoundError
    from inference import Refusal

    ours = CameraError, MotorError, PhotoError, SoundError, Refusal, DeclarationError, ValueOutOfRange
    return isinstance(error, (*ours, OSError))


def _near(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
