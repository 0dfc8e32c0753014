"""One optimisation loop for the tokenizer and both world models: warm-up and cosine, EMA, metrics, exact resume.

Every random number of iteration i comes from a stream named by i, so a run that is stopped and resumed takes the same
steps as one that was not.
"""

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor, nn

from wm_nodes.core.files import open_to_append, text_lines
from wm_nodes.core.progress import tqdm
from wm_nodes.training import checkpoint

CHECKPOINT_PERIOD_S = 240.0
WARMUP_FRACTION = 0.03
WEIGHT_DECAY, MAX_GRAD_NORM = 0.01, 1.0
EMA_DECAY = 0.998
METRICS_EVERY = 20

LossFunction = Callable[[int], dict[str, Tensor]]
"""iteration -> named terms; "loss" is minimised, the others are logged."""


class TrainingLoop:
    """Trains `model` in place; `averaged` is its exponential moving average, the weights to keep.

    Args:
        peak: learning rate after the warm-up.
        run_dir: metrics_<name>.jsonl and checkpoints go here; an existing checkpoint is resumed. None: neither.
    """

    def __init__(self, name: str, model: nn.Module, num_iterations: int, peak: float, run_dir: Path | None) -> None:
        self.name, self.model, self.num_iterations, self.peak, self.run_dir = name, model, num_iterations, peak, run_dir
        self.iteration = 0
        trained = [p for p in model.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(trained, lr=peak, betas=(0.9, 0.95), weight_decay=WEIGHT_DECAY, fused=True)
        self.averaged = {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}
        if self.checkpoint_path is not None and self.checkpoint_path.exists():
            self._resume(self.checkpoint_path)

    @property
    def checkpoint_path(self) -> Path | None:
        return None if self.run_dir is None else self.run_dir / f"checkpoint_{self.name}.safetensors"

    def learning_rate(self, iteration: int) -> float:
        """Linear warm-up, then a half cosine down to 2 % of the peak."""
        warmup = max(1, int(WARMUP_FRACTION * self.num_iterations))
        if iteration < warmup:
            return self.peak * (iteration + 1) / warmup
        share = (iteration - warmup) / max(1, self.num_iterations - warmup)
        return self.peak * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * share)))

    def run(self, loss_function: LossFunction) -> dict[str, float]:
        """Train to the last iteration, load the averaged weights into the model, and return the last metrics."""
        start = last_saved = time.monotonic()
        metrics = self._read_last_metrics()
        bar = tqdm(total=self.num_iterations, initial=self.iteration, desc=self.name)
        self.model.train()
        while self.iteration < self.num_iterations:
            terms = self._step(loss_function)
            bar.update()
            if self.iteration % METRICS_EVERY == 0 or self.iteration == self.num_iterations:
                metrics = {key: float(value) for key, value in terms.items()}
                bar.set_postfix({key: f"{value:.4f}" for key, value in metrics.items()}, refresh=False)
                self._log(metrics, time.monotonic() - start)
            if time.monotonic() - last_saved > CHECKPOINT_PERIOD_S:
                self.save()
                last_saved = time.monotonic()
        bar.close()
        self.save()
        self.model.load_state_dict(self.averaged)
        self.model.eval()
        return metrics

    def _step(self, loss_function: LossFunction) -> dict[str, Tensor]:
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.iteration)
        terms = loss_function(self.iteration)
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), MAX_GRAD_NORM)
        if not torch.isfinite(norm):
            raise FloatingPointError(
                f"{self.name}: gradient is not finite at iteration {self.iteration}; lower the learning rate"
            )
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.iteration += 1
        self._average(min(EMA_DECAY, (1 + self.iteration) / (10 + self.iteration)))
        return {key: value.detach() for key, value in terms.items()} | {"grad_norm": norm.detach()}

    @torch.no_grad()
    def _average(self, decay: float) -> None:
        tensors = self.model.state_dict()
        floats = [key for key, tensor in tensors.items() if tensor.is_floating_point()]
        torch._foreach_lerp_([self.averaged[key] for key in floats], [tensors[key] for key in floats], 1 - decay)
        for key in tensors.keys() - set(floats):
            self.averaged[key].copy_(tensors[key])

    def save(self) -> None:
        """Write model, average, optimiser and iteration, atomically; nothing without a run_dir."""
        if self.checkpoint_path is None:
            return
        sections = {
            "model": self.model.state_dict(), "averaged": self.averaged,
            "optimizer": checkpoint.optimizer_tensors(self.optimizer),
        }
        checkpoint.write_checkpoint(self.checkpoint_path, sections, {"iteration": str(self.iteration)})

    def _resume(self, path: Path) -> None:
        tensors, metadata = checkpoint.read_checkpoint(path)
        try:
            self.model.load_state_dict(checkpoint.section(tensors, "model."))
        except RuntimeError as error:
            raise ValueError(
                f"{path} belongs to another architecture or configuration; give a fresh run folder, or delete the file "
                f"to start over ({error})"
            ) from None
        averaged = checkpoint.section(tensors, "averaged.")
        self.averaged = {key: value.to(self.averaged[key].device, copy=True) for key, value in averaged.items()}
        checkpoint.restore_optimizer(self.optimizer, checkpoint.section(tensors, "optimizer."))
        self.iteration = int(metadata["iteration"])

    def _read_last_metrics(self) -> dict[str, float]:
        """Return the last metrics of a run that is resumed; {} at its start."""
        path = None if self.run_dir is None else self.run_dir / f"metrics_{self.name}.jsonl"
        if self.iteration == 0 or path is None or not path.exists():
            return {}
        for line in reversed(text_lines(path.read_bytes())):
            with suppress(ValueError):  # a killed process may have left half a line
                return {key: value for key, value in json.loads(line).items() if key not in ("iteration", "seconds")}
        return {}

    def _log(self, metrics: Mapping[str, float], seconds: float) -> None:
        if self.run_dir is None:
            return
        self.run_dir.mkdir(parents=True, exist_ok=True)
        line = {"iteration": self.iteration, "seconds": round(seconds, 2), **metrics}
        with open_to_append(self.run_dir / f"metrics_{self.name}.jsonl") as file:
            file.write(json.dumps(line) + "\n")
