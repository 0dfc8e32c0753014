"""What only the system's package manager can bring: a software renderer, a C++ compiler, Python's headers."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, field
from email import message_from_string
from pathlib import Path

from setup.console import SetupError, output_of, run, say

MIN_MESA = (24, 3)
"""The first Mesa whose software renderer (lavapipe) has VK_KHR_external_memory_fd, which SAPIEN needs."""
BACKPORTS_FILE = "/etc/apt/sources.list.d/wm-backports.sources"
DPKG_UPDATES = Path("/var/lib/dpkg/updates")
"""Holds numbered files after dpkg was interrupted; apt-get then refuses to install."""
RENDERER = ("mesa-vulkan-drivers", "libvulkan1")
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
"""Programs that open a page in tests."""


@dataclass(frozen=True)
class AptSource:
    """One enabled `deb` entry of the machine's package sources."""

    uri: str
    suites: tuple[str, ...]
    signed_by: str


@dataclass
class AptPlan:
    """What to install, from where, and why."""

    packages: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    backports: str = ""
    """deb822 text of BACKPORTS_FILE; empty where the configured suites hold what is needed."""
    target: str = ""
    """Value of apt-get's -t, for the renderer only."""

    def add(self, package: str, why: str) -> None:
        self.packages.append(package)
        self.reasons.append(f"{package}{why}")

    def commands(self) -> list[str]:
        """The shell commands, as root would type them."""
        body = self.backports.replace("\n", "\\n")
        lines = [f"printf '{body}' > {BACKPORTS_FILE}"] if body else []
        lines.append("apt-get update")
        renderer = [name for name in self.packages if name in RENDERER]
        others = [name for name in self.packages if name not in RENDERER]
        for names, target in ((others, ""), (renderer, f"-t {self.target} " if self.target else "")):
            if names:
                lines.append(f"apt-get install -y --no-install-recommends {target}" + " ".join(names))
        return lines


def parse_sources(text: str) -> list[AptSource]:
    """Read `.sources` (deb822) or `.list` (one-line) text; disabled and source-code entries are left out."""
    if one_line := [line for line in text.splitlines() if re.match(r"\s*deb\s", line)]:
        return [_parse_line(line) for line in one_line]
    stanzas = re.split(r"\n\s*\n", re.sub(r"(?m)^#.*\n?", "", text))
    return [source for source in map(_parse_stanza, stanzas) if source]


def backports_source(sources: list[AptSource], codename: str) -> str:
    """Return deb822 text for <codename>-backports on the mirror that serves <codename>; empty if it is there already.

    Raises:
        SetupError: no entry serves <codename>, so there is no mirror to derive.
    """
    suite = f"{codename}-backports"
    if any(suite in source.suites for source in sources):
        return ""
    main = next((source for source in sources if codename in source.suites), None)
    if main is None:
        raise SetupError(
            f"no package source for {codename} in /etc/apt/sources.list or /etc/apt/sources.list.d: cannot tell which "
            f"mirror holds {suite}; add that suite yourself and start again"
        )
    signed = f"Signed-By: {main.signed_by}\n" if main.signed_by else ""
    return f"Types: deb\nURIs: {main.uri}\nSuites: {suite}\nComponents: main\n{signed}"


def read_sources(root: Path = Path("/etc/apt")) -> list[AptSource]:
    files = [root / "sources.list", *sorted((root / "sources.list.d").glob("*.list"))]
    files += sorted((root / "sources.list.d").glob("*.sources"))
    texts = [file.read_text(encoding="utf-8", errors="replace") for file in files if file.is_file()]
    return [source for text in texts for source in parse_sources(text)]


def read_os_release(path: Path = Path("/etc/os-release")) -> dict[str, str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    return {key: value.strip('"') for key, _, value in (line.partition("=") for line in lines)}


def mesa_version(text: str) -> tuple[int, int] | None:
    """Return (major, minor) of a package version like `25.0.7-2~bpo12+1`; None where there is none."""
    match = re.match(r"(?:\d+:)?(\d+)\.(\d+)", text.strip())
    return (int(match[1]), int(match[2])) if match else None


def make_plan(
    *, missing_tools: list[str], mesa: str, loader: bool, gpu_renderer: bool, os_release: dict[str, str],
    sources: list[AptSource],
) -> AptPlan:
    """Decide what to install.

    Args:
        missing_tools: package names of absent build tools.
        mesa: installed version of mesa-vulkan-drivers, or an empty string.
        loader: True where libvulkan.so.1 is found.
        gpu_renderer: True where a GPU's own Vulkan driver is installed: Mesa is then not needed.
    """
    plan = AptPlan(packages=list(missing_tools))
    if missing_tools:
        plan.reasons.append(f"{', '.join(missing_tools)}: to build the ROS 2 message types")
    if not loader:
        plan.add("libvulkan1", ": the simulator renders through Vulkan")
    version = mesa_version(mesa)
    if not gpu_renderer and (version is None or version < MIN_MESA):
        present = f"{mesa} is too old" if mesa else "none is installed"
        plan.add("mesa-vulkan-drivers", f" >= 24.3: draws the simulator's images without a GPU ({present})")
        if os_release.get("VERSION_CODENAME") == "bookworm" and os_release.get("ID") == "debian":
            plan.backports = backports_source(sources, "bookworm")
            plan.target = "bookworm-backports"
            plan.reasons.append("from bookworm-backports: Debian 12 itself has Mesa 22.3")
    return plan


def current_plan() -> AptPlan:
    """make_plan for this machine."""
    tools = {"cc": "gcc", "c++": "g++", "make": "make", "cmake": "cmake"}
    missing = [package for tool, package in tools.items() if not shutil.which(tool)]
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        missing.append(f"python{sys.version_info[0]}.{sys.version_info[1]}-dev")
    if not _library("libX11.so.6"):
        missing.append("libx11-6")
    return make_plan(
        missing_tools=missing, mesa=_installed("mesa-vulkan-drivers"), loader=_library("libvulkan.so.1"),
        gpu_renderer=_has_nvidia_vulkan(), os_release=read_os_release(), sources=read_sources(),
    )


def find_browser() -> str | None:
    """Path of an installed Chromium; a snap's wrapper, which does not see temporary folders, does not count."""
    paths = (shutil.which(name) for name in BROWSERS)
    return next((path for path in paths if path and "/snap/" not in os.path.realpath(path)), None)


def browser_plan(browser: str | None, os_release: dict[str, str]) -> AptPlan:
    """What the tests of pages need, and nothing else does: a browser. Ubuntu's package is a snap: none there."""
    plan = AptPlan()
    if browser is None and os_release.get("ID") == "debian":
        plan.add("chromium-headless-shell", ": opens pages in the tests (64 MB)")
    return plan


def install(plan: AptPlan, log: Path) -> bool:
    """Carry out a plan if this user may; otherwise say what to type. Return True when everything is installed."""
    if not plan.packages:
        return True
    for reason in plan.reasons:
        say(f"system package {reason}")
    prefix = _root_prefix()
    if prefix is None or not shutil.which("apt-get"):
        why = "no apt-get here" if not shutil.which("apt-get") else "neither root nor sudo here"
        say(f"cannot install them ({why}); what needs them will not work until root has typed:")
        for command in plan.commands():
            say(f"    {command}")
        return False
    env = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    try:
        for command in plan.commands():
            say(f"running: {command}")
            run([*prefix, "sh", "-c", command], log=log, why="installing system packages", env=env, asks=True)
    except SetupError as error:
        say(str(error))
        if any(DPKG_UPDATES.glob("[0-9]*")):
            say("dpkg was interrupted: `sudo dpkg --configure -a`, then `python3 launch_scripts/setup --system`")
        say("continuing without them")
        return False
    left = current_plan().packages
    if left:
        say(f"{', '.join(left)}: this system's package sources hold no version that is new enough; continuing without")
    return not left


def _has_nvidia_vulkan() -> bool:
    """True where NVIDIA's own Vulkan driver is registered."""
    folders = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
    return any(path.is_file() for folder in folders for path in Path(folder).glob("nvidia_icd*.json"))


def _root_prefix() -> list[str] | None:
    if os.geteuid() == 0:
        return []
    sudo = shutil.which("sudo")
    if not sudo:
        return None
    quiet = subprocess.run([sudo, "-n", "true"], capture_output=True, check=False).returncode == 0
    return [sudo] if quiet or sys.stdin.isatty() else None


def _installed(package: str) -> str:
    """Version of an installed Debian package, else an empty string."""
    if not shutil.which("dpkg-query"):
        icd = any(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
        return f"{MIN_MESA[0]}.{MIN_MESA[1]} (assumed)" if icd else ""
    command = ["dpkg-query", "-W", "-f", "${db:Status-Status} ${Version}", package]
    status, _, version = output_of(command).partition(" ")
    return version if status == "installed" else ""


def _library(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _parse_stanza(text: str) -> AptSource | None:
    """One entry of deb822, whose fields are written as those of a mail."""
    fields = message_from_string(text)
    enabled = fields.get("enabled", "yes").strip().lower() not in {"no", "false", "0"}
    uris = fields.get("uris", "").split()
    if not uris or not enabled or "deb" not in fields.get("types", "").split():
        return None
    # A key written out in the entry spans lines; only a file name can be repeated in another entry.
    key = fields.get("signed-by", "")
    return AptSource(uris[0], tuple(fields.get("suites", "").split()), "" if "\n" in key else key.strip())


def _parse_line(line: str) -> AptSource:
    match = re.match(r"\s*deb\s+(?:\[([^\]]*)\]\s+)?(\S+)\s+(\S+)", line)
    if match is None:
        raise SetupError(f"cannot read the package source {line!r}; see `man sources.list`")
    options = dict(option.partition("=")[::2] for option in (match[1] or "").split())
    return AptSource(match[2], (match[3],), options.get("signed-by", ""))
