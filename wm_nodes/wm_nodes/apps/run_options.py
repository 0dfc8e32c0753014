"""What a run was begun with, kept in its folder, so that --run-dir alone goes on with it.

config.yaml holds the settings, begun_with.json the other options that decide the run. The device is no such option.
"""

import argparse
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from wm_nodes.config.load import Config, ConfigError, dump_config
from wm_nodes.config.saved import (
    DEVICE,
    Load,
    differs,
    load_saved,
    refuse_differences,
    with_device,
    without_device,
)
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import read_json
from wm_nodes.core.run_lock import RunLock

CONFIG, BEGUN = "config.yaml", "begun_with.json"
NOT_GIVEN: tuple[Any, ...] = (None, "", [])
UNKNOWN_BEFORE = ("preset", "model_dir", "run_folder")
"""Options that folders without begun_with.json do not tell; the others are comments in their config.yaml."""
OPTION_OF = {
    "seed": "--seed", "task": "--task", "simulation.scenes": "--scenes", "model_refresh.num_rounds": "--rounds",
    "rewards": "--reward", "sft.bags": "--demos",
    "judge.kind": "--judge", "judge.endpoints": "--judge", "judge.folder": "--judge", "judge.model": "--judge-model",
    "judge.api_key_env": "--judge-key-env", "judge.rubric": "--rubric",
    "run_folder": "run",
}
"""What the user calls settings that have an option of their own, and what is no option."""


@contextmanager
def open_run(
    arguments: argparse.Namespace, verb: str, *, name: Callable[[Config], str], load: Load[Config],
    check: Callable[[Config], None], settings: Mapping[str, Any], fixed: Sequence[str], free: Sequence[str] = (),
    defaults: Mapping[str, Any],
) -> Iterator[tuple[Config, Path]]:
    """Hold the run folder of --run-dir, or a new one, and give its configuration; options that were not given are set
    in `arguments` to those that the run was begun with, paths as text.

    Args:
        name: of a new folder, behind its time.
        load: the configuration of a preset or YAML file with changes. check: raises for one that is no use.
        settings: the dotted settings that the given options stand for.
        fixed: other options that decide the run: they must be those it was begun with.
        free: options that are kept, too, and may be given anew.
        defaults: of both kinds, which argparse leaves at None.

    Raises:
        ConfigError: the folder was begun with other options; names each. RunFolderInUseError: see RunLock.
    """
    given = {option: _plain(getattr(arguments, option)) for option in (*fixed, *free)}
    with ExitStack() as stack:
        run_dir = arguments.run_dir and Path(arguments.run_dir).expanduser().absolute()
        if run_dir:
            stack.enter_context(RunLock(run_dir))
        saved = run_dir and run_dir / CONFIG
        if saved and saved.exists():
            begun = _read_begun(run_dir, verb, {option: defaults.get(option, []) for option in fixed})
            told = [
                differs(OPTION_OF.get(option, f"--{option.replace('_', '-')}"), begun[option], given[option])
                for option in fixed
                if given[option] not in NOT_GIVEN and begun.get(option, given[option]) != given[option]
            ]
            _fill(arguments, given, begun, defaults)
            preset = None if "preset" in begun else given.get("preset")
            config, more = load_saved(load, saved, preset, settings, OPTION_OF)
            refuse_differences(run_dir, told + more)
            check(config)
            if DEVICE in settings:
                write_atomic(saved, with_device(saved.read_bytes(), config.device))
        else:
            _fill(arguments, given, {}, defaults)
            config = load(getattr(arguments, "preset", ""), dict(settings))
            check(config)
            if not run_dir:
                new = Path("runs", f"{time.strftime('%Y%m%d-%H%M%S')}-{name(config)}").absolute()
                run_dir = stack.enter_context(RunLock(new, new=True)).folder
        kept = {"verb": verb, **{option: getattr(arguments, option) for option in given}}
        if not (run_dir / CONFIG).exists():
            data = dump_config(config).encode()
            _write(run_dir, {**kept, "config_sha256": _sha256(data)})
            write_atomic(run_dir / CONFIG, data)
        elif (run_dir / BEGUN).exists() and begun != {**begun, **kept}:
            _write(run_dir, {**begun, **kept})
        yield config, run_dir


def _fill(
    arguments: argparse.Namespace, given: Mapping[str, Any], begun: Mapping[str, Any], defaults: Mapping[str, Any]
) -> None:
    for option, value in given.items():
        chosen = begun.get(option) if value in NOT_GIVEN else value
        setattr(arguments, option, defaults.get(option, value) if chosen is None else chosen)


def _plain(value: Any) -> Any:
    """An option's value as begun_with.json holds it: paths in full, also that of a preset's file."""
    if isinstance(value, list):
        return [_plain(part) for part in value]
    if isinstance(value, Path) or Path(str(value)).suffix in {".yaml", ".yml"}:
        return str(Path(value).expanduser().resolve())
    return value


def _write(run_dir: Path, begun: Mapping[str, Any]) -> None:
    write_atomic(run_dir / BEGUN, (json.dumps(begun, indent=1) + "\n").encode())


def _sha256(config: bytes) -> str:
    """Of all that a run's settings fix."""
    return hashlib.sha256(without_device(config)).hexdigest()


def _read_begun(run_dir: Path, verb: str, fixed: Mapping[str, Any]) -> dict[str, Any]:
    """Options by name. fixed: what they are where a folder without the file does not say otherwise."""
    data = (run_dir / CONFIG).read_bytes() if (run_dir / CONFIG).is_file() else b""
    if not (run_dir / BEGUN).exists():
        begun = {option: value for option, value in fixed.items() if option not in UNKNOWN_BEFORE}
        for line in data.decode(errors="replace").split("\n"):
            option, _, value = line.removeprefix("# begun with --").partition(" ")
            option = option.replace("-", "_")
            if line.startswith("# begun with --") and option in begun:
                begun[option] = [*begun[option], value] if isinstance(begun[option], list) else value or True
        return begun
    begun = read_json(run_dir / BEGUN, "restore it, or begin another run folder")
    if begun.get("verb") != verb:
        raise ConfigError(f"{run_dir} is a run of {begun.get('verb')!r}, not of {verb!r}; name another run folder")
    if data and _sha256(data) != begun.get("config_sha256"):
        raise ConfigError(
            f"{run_dir / CONFIG} is not what the run was begun with (sha256 differs); restore it, or begin another run "
            "folder"
        )
    return begun
