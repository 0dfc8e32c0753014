"""video_model: samples groups of clips of recorded contexts, keeps them as rollout buffers, and shows them."""

import hashlib
import sys
import time
from pathlib import Path
from typing import Any

import torch

from wm_msgs.action import GenerateClips
from wm_msgs.msg import ClipBatch, PolicyVersion
from wm_nodes.config.load import load_video_config
from wm_nodes.core.device import compute_device
from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import UInt8Array
from wm_nodes.nodes.policy.weights import read_weights
from wm_nodes.recording.layout import Tiles
from wm_nodes.ros import convert
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.worker import Work
from wm_nodes.training.run_folder import VersionFiles
from wm_nodes.training.weights import load_weights
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.sampling import RecordedContexts

PARAMS = (
    Param("video_model_dir", "", "Folder of the trained video model", read_only=True),
    Param("context_bags", [""], "Bags whose episodes give first frames, actions and instruction", read_only=True),
    Param("keep_buffers", 4, "Rollout buffers kept in run_dir/buffers", minimum=1, maximum=100000),
    Param("version_timeout_s", 20.0, "How long the asked version may take to be announced", "s",
          minimum=0.1, maximum=600.0),
)


BUFFER_FILES = VersionFiles("buffers/buffer")
VERSIONS_KNOWN = 20
"""Announcements kept, newest last."""


class VideoModelNode(ManagedNode):
    """Action video/generate; follows video/version; publishes clips, clips/image."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("video_model", PARAMS, **node_arguments)

    def configure(self) -> None:
        config = load_video_config(str(self.param("config_file")))
        folder = load_video_folder(Path(str(self.param("video_model_dir"))), compute_device(config.device))
        bags = [Path(text) for text in self.param("context_bags") if text]
        contexts = load_clips(bags, folder.clip["stride"], config.clip_steps, config.task)
        self._generator = RecordedContexts(folder, contexts, config)
        self._files = named_files(self)
        self._loaded = (0, "")  # version and, unless it is the folder's own, sha256
        self._announced = dict[int, PolicyVersion]()
        self._clips = self.publish_on("clips")
        self._images = self.publish_unnumbered("clips/image")
        self.listen("video/version", self._on_version, while_inactive=True)
        self._action = WorkerAction(self, GenerateClips, "video/generate", self._generate)

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)

    def update_diagnostics(self) -> None:
        if hasattr(self, "_loaded"):
            self.diagnostics.gauge("version", self._loaded[0])

    def _on_version(self, message: PolicyVersion) -> None:
        self._announced.pop(message.version, None)
        self._announced[message.version] = message
        if len(self._announced) > VERSIONS_KNOWN:
            del self._announced[next(iter(self._announced))]

    # Sampling, in a worker thread.

    def _generate(self, work: Work, result: GenerateClips.Result) -> None:
        goal: GenerateClips.Goal = work.request
        self._follow(work, int(goal.policy_version))
        began = time.perf_counter()
        request = self._generator.request(int(goal.iteration), int(goal.policy_version))

        def report(done: int, total: int) -> None:
            work.check()
            work.feedback(GenerateClips.Feedback(clips_done=done, progress=done / total))

        buffer = self._generator.sample(request, on_progress=report)
        data = buffer.to_bytes()
        result.buffer_uri = BUFFER_FILES.uri(goal.iteration)
        result.sha256, result.num_clips = hashlib.sha256(data).hexdigest(), len(buffer)
        write_atomic(self.run_dir / result.buffer_uri, data)
        self._forget_old()
        message = ClipBatch(
            iteration=goal.iteration, policy_version=goal.policy_version, contexts=list(request.contexts),
            group_size=request.group_size, num_frames=buffer.rollout.latents.shape[2], buffer_uri=result.buffer_uri,
            sha256=result.sha256, sample_s=time.perf_counter() - began, noise_share=buffer.rollout.spent_noise,
        )
        self._publish(message, film_strip(self._generator.folder.codec.decode(buffer.rollout.latents)))
        self.diagnostics.latency("sample", message.sample_s)

    def _follow(self, work: Work, version: int) -> None:
        """Have the weights of `version`, which need not be the newest that was announced: others may announce, too.

        Raises:
            WireError: its file cannot be read. WeightsError: the file is not the announced one.
            ValueError: it is not announced within version_timeout_s.
        """
        deadline = time.monotonic() + float(self.param("version_timeout_s"))
        while version not in self._announced and version != self._loaded[0]:
            if time.monotonic() > deadline:
                known = ", ".join(map(str, list(self._announced))) or "none"
                raise ValueError(f"asked for version {version}, video/version announced {known}; is a learner there?")
            work.sleep(0.02)
        message = self._announced.get(version)
        if message is not None and self._loaded != (version, message.sha256):
            load_weights(self._generator.folder.network, read_weights(message.uri, self._files), sha256=message.sha256)
            self._loaded = (version, message.sha256)

    def _publish(self, message: ClipBatch, strip: UInt8Array) -> None:
        stamp = self.get_clock().now().nanoseconds
        message.header = convert.header(stamp, "")
        self._images.publish(convert.image_msg(strip, stamp))
        self._clips.publish(message)

    def _forget_old(self) -> None:
        written = [self.run_dir / BUFFER_FILES.uri(number) for number in BUFFER_FILES.versions(self.run_dir)]
        newest_last = sorted(written, key=lambda path: path.lstat().st_mtime_ns)
        for path in newest_last[: -int(self.param("keep_buffers"))]:
            path.unlink(missing_ok=True)


def film_strip(frames: torch.Tensor) -> UInt8Array:
    """One picture of uint8 clips (N, F, H, W, 3): a row per clip, a column per frame, (N H, F W, 3)."""
    N, F, H, W, _ = frames.shape
    return Tiles(N, F, H, W).tile(frames.flatten(0, 1).cpu().numpy())


def main() -> int:
    return run_node(VideoModelNode)


if __name__ == "__main__":
    sys.exit(main())
