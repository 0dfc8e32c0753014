"""Rendering device: a GPU if there is one, else Mesa's software device, which needs one repair of ManiSkill 3.0.1."""

import functools

import sapien
from mani_skill.envs.utils.system import backend as maniskill_backend

SOFTWARE_DEVICE = "pci:0"


class NoRendererError(OSError):
    """No Vulkan device can render. An OSError, so that nodes and commands report it as one line."""


@functools.cache
def keep_pci_names_whole() -> None:
    """Let ManiSkill accept `pci:0`: its parser splits device names at the colon, and then no CPU device is found."""
    original = maniskill_backend.parse_backend_device_id

    def parse(backend: str) -> tuple[str, int | None]:
        return (backend, None) if backend.startswith("pci:") else original(backend)

    maniskill_backend.parse_backend_device_id = parse


def render_backend(device: str) -> str:
    """Return the ManiSkill render backend for `device` (auto, gpu, cuda:N, or pci:N).

    Raises:
        NoRendererError: the device cannot render; names the remedy.
    """
    candidates = ["cuda", SOFTWARE_DEVICE] if device == "auto" else [device.replace("gpu", "cuda")]
    for name in candidates:
        try:
            if sapien.Device(name).can_render():
                if name.startswith("pci:"):
                    keep_pci_names_whole()
                return name
        except RuntimeError:
            continue
    raise NoRendererError(
        f"no renderer at {' or '.join(candidates)}: Vulkan finds no device. On a machine without a GPU install Mesa's "
        "lavapipe 24.3 or newer (Debian 12: mesa-vulkan-drivers from bookworm-backports) and libvulkan1; "
        "launch_scripts/wm_setup.py does it when it may"
    )
