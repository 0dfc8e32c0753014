"""A run folder of loop 2: the learner with its versions, checkpoint and metrics, resumed where it stopped.

versions: run_dir/video_policies/video_<optimizer steps>.safetensors; version 0 is the model's own folder.
"""

import json
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import device_of, explain_memory
from wm_nodes.training.checkpoint import RESTORE, DamagedFileError, read_metadata
from wm_nodes.training.metrics import MetricsWriter, read_metrics
from wm_nodes.training.run_folder import TrainingRun, VersionFiles
from wm_nodes.training.weights import PackedWeights, save_weights
from wm_nodes.video_model import RolloutBuffer, VideoNetwork
from wm_nodes.video_rl.grpo import BufferReport, GrpoLearner
from wm_nodes.video_rl.reward_hacking import SECTION, hacking_alarms, watched_scores
from wm_nodes.video_rl.validation import HeldoutScores

CHECKPOINT = "checkpoints/video_learner.safetensors"
VIDEO_FILES = VersionFiles("video_policies/video")


def progress(run_dir: Path) -> tuple[int, int]:
    """Return version and number of buffers trained on, from the learner's checkpoint; (0, 0) where there is none.

    Raises:
        DamagedFileError: it is cut short; names it.
    """
    path = run_dir / CHECKPOINT
    if not path.is_file():
        return 0, 0
    try:
        header = json.loads(read_metadata(path)["grpo"])
        return int(header["version"]), int(header["iteration"])
    except KeyError as error:
        raise DamagedFileError(f"{path} is no checkpoint of GRPO (no {error}); {RESTORE}") from None


class VideoRun(TrainingRun):
    """Trains `network` on buffers; every buffer leaves a version, a checkpoint and a line of metrics.

    Args:
        keep_versions: files kept in run_dir/video_policies, at least 2.
        heldout: scores of held-out contexts by the network's weights, asked for after every `evaluation.every`-th
            buffer; None: never.
    """

    files, checkpoint = VIDEO_FILES, CHECKPOINT

    def __init__(
        self, network: VideoNetwork, config: VideoRlConfig, run_dir: Path, *, keep_versions: int = 20,
        tensorboard: bool = False, heldout: HeldoutScores | None = None,
    ) -> None:
        super().__init__(run_dir, keep_versions)
        self.network, self.config, self._heldout = network, config, heldout
        self._training = threading.Lock()
        self.learner = GrpoLearner(network, config.grpo, config.rollout, seed=config.seed)
        if (run_dir / CHECKPOINT).is_file():
            self.learner.load(run_dir / CHECKPOINT)
        self._metrics = MetricsWriter(run_dir, tensorboard=tensorboard)
        self.check: Callable[[], None] = lambda: None
        """Called before every call of the network; what it raises ends the training with nothing changed."""
        self.alarms: dict[str, float] = {}
        """Of reward hacking, by the newest held-out evaluation (DD-2), see hacking_alarms."""

    @property
    def version(self) -> int:
        return self.learner.version

    @property
    def iterations(self) -> int:
        """Buffers trained on in the run folder."""
        return self.learner.iterations

    updates = iterations

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Train on one buffer with rewards, or skip it (see GrpoLearner.train), then save.

        Raises:
            As GrpoLearner.train; or OSError where saving fails: the training was then made; ensure_saved() tries again.
        """
        with self._training:
            self._watch()  # where the process ended while it looked
            stops = self.network.register_forward_pre_hook(lambda *_: self.check())
            device, micro_batch = device_of(self.network), self.config.grpo.micro_batch
            with stops, explain_memory(device, grpo__micro_batch=micro_batch):
                if self.config.rollout.buffer_device == "model":
                    buffer = buffer.to(device)
                report = self.learner.train(buffer)
            self.save()
            self._metrics.write("grpo", self.iterations, flatten_metrics(report))
            self._watch()
            return report

    def write_files(self) -> PackedWeights:
        packed = save_weights(self.network, self.run_dir / self.files.uri(self.version), {"version": str(self.version)})
        self.learner.save(self.run_dir / CHECKPOINT)
        return packed

    def close(self) -> None:
        """Wait for the training at hand."""
        with self._training:
            self._metrics.close()

    def _watch(self) -> None:
        """Evaluate the weights of now where that is due and not done."""
        every, step = self.config.evaluation.every, self.iterations
        if self._heldout is None or not every or not step or step % every:
            return
        lines = read_metrics(self.run_dir)
        if any((line["section"], line["step"]) == (SECTION, step) for line in lines):
            return
        scores = self._heldout()
        lines.append({"section": SECTION, "step": step, **scores})
        watched = watched_scores(self.config.groups.hide_actions)
        self.alarms = hacking_alarms(lines, self.config.evaluation.window, watched)
        self._metrics.write(SECTION, step, {**scores, **self.alarms})


def flatten_metrics(report: BufferReport) -> dict[str, float]:
    """Return one number per name; those of the k-th optimizer step on a buffer end in _<k>, from 1."""
    values = asdict(report)
    updates, rewards = values.pop("updates"), values.pop("raw_rewards")
    metrics = {name: float(value) for name, value in values.items()}
    metrics |= {f"reward_{name}": value for name, value in rewards.items()}
    for index, update in enumerate(updates, 1):
        metrics |= {f"{name}_{index}": float(value) for name, value in update.items()}
    return metrics
