"""Checkpoints that resume exactly: models, optimisers, random states and counters in one safetensors file.

Used by every learner. Tensors are named <kind>/<owner>/<name>; everything else is JSON in the file's header. No pickle.
"""

import json
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.optim import Optimizer

from wm_nodes.learning.files import write_atomic
from wm_nodes.learning.weights import WeightsError, check_same_layout

FORMAT_VERSION = 1

_KEY = "wm_nodes_checkpoint"

Generators = Mapping[str, torch.Generator | np.random.Generator]
Counters = dict[str, Any]


class CheckpointError(ValueError):
    """A checkpoint that is damaged, or belongs to another architecture or another kind of run."""


def save_checkpoint(
    path: Path,
    *,
    modules: Mapping[str, nn.Module],
    optimizers: Mapping[str, Optimizer] | None = None,
    counters: Mapping[str, Any] | None = None,
    generators: Generators | None = None,
) -> None:
    """Write a checkpoint atomically: temporary name, flush to disk, rename.

    Args:
        counters: anything JSON holds exactly: numbers, texts, lists, the resolved configuration.
        generators: random generators of the run. The global states of torch, NumPy and `random` are always included.
    """
    tensors: dict[str, Tensor] = {}
    header: dict[str, Any] = {"format": FORMAT_VERSION, "counters": dict(counters or {})}
    header["modules"] = sorted(modules)
    for owner, module in modules.items():
        tensors |= {f"module/{owner}/{name}": tensor for name, tensor in module.state_dict().items()}
    header["optimizers"] = {}
    for owner, optimizer in (optimizers or {}).items():
        state = optimizer.state_dict()
        values: dict[str, dict[str, Any]] = {}
        for index, entry in state["state"].items():
            for name, value in entry.items():
                if isinstance(value, Tensor):
                    tensors[f"optimizer/{owner}/{index}/{name}"] = value
                else:
                    values.setdefault(str(index), {})[name] = value
        header["optimizers"][owner] = {"groups": state["param_groups"], "values": values}
    header["random"], states = _random_states(generators or {})
    tensors |= {f"random/{name}": state for name, state in states.items()}
    stored = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    write_atomic(path, save(stored, {_KEY: json.dumps(header, sort_keys=True)}))


def load_checkpoint(
    path: Path,
    *,
    modules: Mapping[str, nn.Module],
    optimizers: Mapping[str, Optimizer] | None = None,
    generators: Generators | None = None,
) -> Counters:
    """Restore everything in place and return the counters. Nothing is changed when an error is raised.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: damaged, or of another architecture (names the first difference).
    """
    tensors, header = _read(path)
    optimizers, generators = optimizers or {}, generators or {}
    try:
        for owner, module in modules.items():
            check_same_layout(
                module.state_dict(), _owned(tensors, "module", owner), what=f"checkpoint {path} ({owner})"
            )
    except WeightsError as error:
        raise CheckpointError(str(error)) from None
    for what, wanted, held in (
        ("modules", set(modules), set(header["modules"])),
        ("optimizers", set(optimizers), set(header["optimizers"])),
        ("generators", set(generators), set(header["random"]["generators"])),
    ):
        if wanted != held:
            raise CheckpointError(f"checkpoint {path} holds {what} {sorted(held)}, expected {sorted(wanted)}")
    states = {name: _optimizer_state(path, name, tensors, header, optimizer) for name, optimizer in optimizers.items()}
    for owner, module in modules.items():
        module.load_state_dict(_owned(tensors, "module", owner))
    for name, optimizer in optimizers.items():
        optimizer.load_state_dict(states[name])
    _restore_random(header["random"], tensors, generators)
    counters: Counters = header["counters"]
    return counters


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    data = path.read_bytes()
    try:
        tensors = load(data)
        texts = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__", {})
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"checkpoint {path} is damaged or cut short ({len(data)} bytes): {error}") from None
    if _KEY not in texts:
        raise CheckpointError(f"{path} is a safetensors file, but no checkpoint of a learner; name one of checkpoints/")
    header: dict[str, Any] = json.loads(texts[_KEY])
    if header["format"] != FORMAT_VERSION:
        raise CheckpointError(f"checkpoint {path} has format {header['format']}, this version reads {FORMAT_VERSION}")
    return tensors, header


def _owned(tensors: Mapping[str, Tensor], kind: str, owner: str) -> dict[str, Tensor]:
    prefix = f"{kind}/{owner}/"
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _optimizer_state(
    path: Path, owner: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any], optimizer: Optimizer
) -> dict[str, Any]:
    saved = header["optimizers"][owner]
    current = optimizer.state_dict()["param_groups"]
    counts = [len(group["params"]) for group in saved["groups"]]
    if counts != [len(group["params"]) for group in current]:
        expected = [len(group["params"]) for group in current]
        raise CheckpointError(f"checkpoint {path}: optimizer {owner} has parameters {counts} per group, not {expected}")
    groups = [
        {key: tuple(value) if isinstance(now.get(key), tuple) else value for key, value in group.items()}
        for group, now in zip(saved["groups"], current, strict=True)
    ]
    state: dict[int, dict[str, Any]] = {int(index): dict(values) for index, values in saved["values"].items()}
    for name, tensor in _owned(tensors, "optimizer", owner).items():
        index, _, key = name.partition("/")
        state.setdefault(int(index), {})[key] = tensor
    return {"state": state, "param_groups": groups}


def _random_states(generators: Generators) -> tuple[dict[str, Any], dict[str, Tensor]]:
    states: dict[str, Tensor] = {"torch": torch.get_rng_state()}
    if torch.cuda.is_available():
        states |= {f"cuda/{i}": state for i, state in enumerate(torch.cuda.get_rng_state_all())}
    numpy_state: Any = np.random.get_state(legacy=False)
    own: dict[str, Any] = {}
    for name, generator in generators.items():
        if isinstance(generator, torch.Generator):
            own[name] = None
            states[f"generator/{name}"] = generator.get_state()
        else:
            own[name] = _plain(generator.bit_generator.state)
    return {"numpy": _plain(numpy_state), "python": random.getstate(), "generators": own}, states


def _restore_random(saved: Mapping[str, Any], tensors: Mapping[str, Tensor], generators: Generators) -> None:
    torch.set_rng_state(tensors["random/torch"])
    if torch.cuda.is_available():
        for i in range(torch.cuda.device_count()):
            if f"random/cuda/{i}" in tensors:
                torch.cuda.set_rng_state(tensors[f"random/cuda/{i}"], i)
    np.random.set_state(_rebuilt(saved["numpy"]))
    version, state, gauss = saved["python"]
    random.setstate((version, tuple(state), gauss))
    for name, generator in generators.items():
        if isinstance(generator, torch.Generator):
            generator.set_state(tensors[f"random/generator/{name}"])
        else:
            generator.bit_generator.state = _rebuilt(saved["generators"][name])


def _plain(value: Any) -> Any:
    """Arrays to marked lists, so that JSON can hold the state of a NumPy generator."""
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def _rebuilt(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"array", "dtype"}:
            return np.array(value["array"], dtype=value["dtype"])
        return {key: _rebuilt(entry) for key, entry in value.items()}
    return value
