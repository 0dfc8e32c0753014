"""Rendering device: a GPU if there is one, else Mesa's software device, which needs one repair of ManiSkill 3.0.1 and
draws its first picture thirteen times as fast with another."""

import functools
import hashlib
import os
from pathlib import Path

import sapien
from mani_skill.envs.utils.system import backend as maniskill_backend
from mani_skill.render import ShaderConfig
from mani_skill.sensors import camera as maniskill_camera

from wm_nodes.core.files import write_atomic

SOFTWARE_DEVICE = "pci:0"
SHADERS = Path(sapien.__file__).parent / "vulkan_shader"
TABLE = "uniform sampler2D samplerBRDFLUT;"
TABLE_READ = "texture(samplerBRDFLUT, vec2(roughness, dotNV)).xy"


class NoRendererError(OSError):
    """No Vulkan device can render. An OSError, so that nodes and commands report it as one line."""


@functools.cache
def keep_pci_names_whole() -> None:
    """Let ManiSkill accept `pci:0`: its parser splits device names at the colon, and then no CPU device is found."""
    original = maniskill_backend.parse_backend_device_id

    def parse(backend: str) -> tuple[str, int | None]:
        return (backend, None) if backend.startswith("pci:") else original(backend)

    maniskill_backend.parse_backend_device_id = parse


@functools.cache
def leave_out_reflection_table() -> None:
    """Let cameras use ManiSkill's `minimal` shaders without their table of how a surface reflects an environment map.

    SAPIEN computes that table in every process before the first picture, which takes 10 s of a CPU. No scene of ours
    has an environment map, so its factor is always 0 and the pictures stay the same to the bit.
    """
    folder = shaders_without_table()
    if folder is None:
        return
    original = maniskill_camera.set_shader_pack

    def set_shader_pack(config: ShaderConfig) -> None:
        original(config)
        if config.shader_pack == "minimal":
            sapien.render.set_camera_shader_dir(str(folder / "minimal"))

    maniskill_camera.set_shader_pack = set_shader_pack


def shaders_without_table() -> Path | None:
    """Return a folder with the packs `common` and `minimal` as installed, less the table; made once per version of them
    in the user's cache folder. None where that cannot be written, or the shaders are not those that we know."""
    try:
        texts = {path.relative_to(SHADERS): _without_table(path.read_text(encoding="utf-8"))
                 for pack in ("common", "minimal") for path in sorted((SHADERS / pack).iterdir())}
        if any("BRDFLUT" in text for text in texts.values()):
            return None
        version = hashlib.sha256("".join(f"{name}\n{text}" for name, text in texts.items()).encode()).hexdigest()
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wm_nodes"
        folder = cache / f"shaders_{version[:16]}"
        for name, text in texts.items():
            if not (folder / name).exists():
                write_atomic(folder / name, text.encode())
        as_made = all((folder / name).read_text(encoding="utf-8") == text for name, text in texts.items())
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return None
    return folder if as_made else None


def _without_table(shader: str) -> str:
    lines = [line for line in shader.splitlines(keepends=True) if TABLE not in line]
    return "".join(lines).replace(TABLE_READ, "vec2(0)")


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
                    leave_out_reflection_table()
                return name
        except RuntimeError:
            continue
    raise NoRendererError(
        f"no renderer at {' or '.join(candidates)}: Vulkan finds no device. On a machine without a GPU install Mesa's "
        "lavapipe 24.3 or newer (Debian 12: mesa-vulkan-drivers from bookworm-backports) and libvulkan1; "
        "launch_scripts/setup does it when it may"
    )
