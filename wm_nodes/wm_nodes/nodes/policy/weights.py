"""The policy of a node and the version of its weights; weights are swapped between steps, never within one."""

import threading

from wm_msgs.msg import ErrorCode, PolicyVersion
from wm_nodes.core.device import explain_memory
from wm_nodes.core.errors import WireError
from wm_nodes.core.named_files import WEIGHTS, FileRefused, NamedFiles, shown
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.nodes.factories import existing
from wm_nodes.policy_rl.image_policy import ImagePolicy, PolicyOutput
from wm_nodes.ros import convert
from wm_nodes.training.weights import WeightsError, arch_hash, load_weights


class PolicyHolder:
    """Thread-safe. version: the learner step of the weights that act; 0 before any."""

    def __init__(self, policy: ImagePolicy) -> None:
        self.policy = policy
        self._lock = threading.Lock()
        self._arch_hash = arch_hash(policy.state_dict())
        self.version = 0
        self.sha256 = ""

    def act(self, images: UInt8Array, states: FloatArray, noise: FloatArray | None) -> tuple[PolicyOutput, int]:
        """Return actions for (N, H, W, 3) images and (N, S) states, and the version that chose them.

        Raises:
            DeviceError: too little memory for so many environments.
        """
        with self._lock, explain_memory(self.policy.device, ppo__num_envs=len(images)):
            return self.policy.act(images, states, noise=noise), self.version

    def follow(self, message: PolicyVersion, files: NamedFiles) -> bool:
        """Load an announced version; return False for the one already loaded. The old weights stay on an error.

        Raises:
            WireError: HASH_MISMATCH for damaged or foreign weights; as read_weights.
        """
        if message.sha256 == self.sha256 and message.version == self.version:
            return False
        if not message.sha256:
            raise WireError(ErrorCode.HASH_MISMATCH, f"policy version {message.version} has no sha256; announce one")
        if message.arch_hash and message.arch_hash != self._arch_hash:
            raise WireError(
                ErrorCode.HASH_MISMATCH,
                f"policy version {message.version} has architecture {message.arch_hash[:12]}, this node's policy "
                f"{self._arch_hash[:12]}; start both with the same config_file and model_dir",
            )
        inline = bytes(message.inline_data)
        self.load(inline or read_weights(message.uri, files), message.version, message.sha256)
        return True

    def load(self, data: bytes, version: int, sha256: str = "") -> None:
        """Take over safetensors bytes. Raises WireError(HASH_MISMATCH); the old weights stay."""
        try:
            with self._lock:
                load_weights(self.policy, data, sha256=sha256 or None)
                self.version, self.sha256 = version, sha256
        except WeightsError as error:
            raise WireError(ErrorCode.HASH_MISMATCH, f"policy version {version} refused: {error}") from None


def load_initial(policy: ImagePolicy, name: str) -> None:
    """Load the weights file that the parameter initial_policy names, if any. Raises ValueError: missing, or foreign."""
    if not name:
        return
    path = existing(name, "initial_policy")
    try:
        load_weights(policy, path.read_bytes())
    except WeightsError as error:
        raise ValueError(f"initial_policy {path}: {error}") from None


def read_weights(uri: str, files: NamedFiles) -> bytes:
    """Read a weights file that a message names. Raises WireError: OUT_OF_RANGE outside of the folders, IO_ERROR."""
    try:
        return files.read(uri, WEIGHTS)
    except FileRefused as error:
        raise convert.refusal_of(error) from None
    except OSError as error:
        text = f"cannot read weights {shown(uri)}: {error.strerror}; name a file that is in the run folder"
        raise WireError(ErrorCode.IO_ERROR, text) from None
