"""Which system packages are asked for, derived from texts of package sources; nothing is installed here."""

from pathlib import Path

import pytest

from setup import system
from setup.console import SetupError

BOOKWORM = {"ID": "debian", "VERSION_CODENAME": "bookworm"}
NOBLE = {"ID": "ubuntu", "VERSION_CODENAME": "noble"}
DEB822 = """\
Types: deb deb-src
# a comment inside
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: http://mirror.example/debian-security
Suites: bookworm-security
Components: main
"""
ONE_LINE = """\
# deb http://disabled.example/debian bookworm main
deb-src http://mirror.example/debian bookworm main
deb [arch=amd64 signed-by=/etc/apt/keyrings/a.gpg] https://near.example/debian/ bookworm main contrib # near
"""


def plan(mesa: str, os_release: dict[str, str], text: str = DEB822, **changes: object) -> system.AptPlan:
    given = {"missing_tools": [], "mesa": mesa, "loader": True, "gpu_renderer": False} | changes
    return system.make_plan(os_release=os_release, sources=system.parse_sources(text), **given)


def test_deb822_source_gives_the_mirror_and_its_key() -> None:
    text = plan("22.3.6-1+deb12u1", BOOKWORM).backports
    assert text == (
        "Types: deb\nURIs: http://mirror.example/debian\nSuites: bookworm-backports\nComponents: main\n"
        "Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg\n"
    )


def test_one_line_source_gives_the_mirror_and_its_key() -> None:
    text = plan("", BOOKWORM, ONE_LINE).backports
    assert "URIs: https://near.example/debian/\n" in text
    assert "Signed-By: /etc/apt/keyrings/a.gpg\n" in text


def test_debian_12_installs_mesa_from_backports() -> None:
    commands = plan("22.3.6-1+deb12u1", BOOKWORM, loader=False).commands()
    assert commands[0].startswith("printf 'Types: deb\\nURIs: http://mirror.example/debian\\n")
    assert commands[0].endswith("> /etc/apt/sources.list.d/wm-backports.sources")
    assert commands[1] == "apt-get update"
    assert commands[2].endswith("-t bookworm-backports libvulkan1 mesa-vulkan-drivers")


def test_backports_that_are_configured_already_are_not_added_again() -> None:
    text = DEB822 + "\nTypes: deb\nURIs: http://mirror.example/debian\nSuites: bookworm-backports\nComponents: main\n"
    made = plan("", BOOKWORM, text)
    assert not made.backports and made.target == "bookworm-backports"


def test_disabled_backports_do_not_count() -> None:
    text = DEB822 + "\nTypes: deb\nEnabled: no\nURIs: http://m.example\nSuites: bookworm-backports\nComponents: main\n"
    assert plan("", BOOKWORM, text).backports


def test_key_written_out_in_the_entry_is_not_repeated_as_a_file_name() -> None:
    text = (
        "Types: deb\nURIs: http://m.example/d\nSuites: bookworm\nComponents: main\nSigned-By:\n -----BEGIN\n .\n abc\n"
    )
    assert "Signed-By" not in plan("", BOOKWORM, text).backports


def test_no_source_for_the_release_says_so() -> None:
    with pytest.raises(SetupError, match="bookworm-backports; add that suite"):
        plan("", BOOKWORM, "deb http://m.example/debian trixie main\n")


def test_ubuntu_24_04_needs_no_other_suite() -> None:
    made = plan("", NOBLE)
    assert made.packages == ["mesa-vulkan-drivers"] and not made.backports
    assert made.commands()[-1] == "apt-get install -y --no-install-recommends mesa-vulkan-drivers"


@pytest.mark.parametrize("mesa", ["24.3.0-1", "25.0.7-2~bpo12+1", "1:25.2.1"])
def test_new_enough_mesa_needs_nothing(mesa: str) -> None:
    assert plan(mesa, BOOKWORM).packages == []


@pytest.mark.parametrize("mesa", ["24.2.8-1ubuntu1~24.04.1", "22.3.6"])
def test_old_mesa_is_replaced(mesa: str) -> None:
    assert "mesa-vulkan-drivers" in plan(mesa, NOBLE).packages


def test_gpu_with_its_own_vulkan_driver_needs_no_mesa() -> None:
    assert plan("", BOOKWORM, gpu_renderer=True).packages == []


def test_missing_compiler_is_installed_from_the_main_suite() -> None:
    commands = plan("", BOOKWORM, missing_tools=["g++", "cmake"]).commands()
    assert "apt-get install -y --no-install-recommends g++ cmake" in commands


def test_without_root_the_commands_are_named_and_the_set_up_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(system.os, "geteuid", lambda: 1000)
    monkeypatch.setenv("PATH", "")
    assert not system.install(plan("22.3.6", BOOKWORM), tmp_path / "log")
    said = capsys.readouterr().err
    assert "neither root nor sudo" in said or "no apt-get" in said
    assert "-t bookworm-backports mesa-vulkan-drivers" in said
    assert not (tmp_path / "log").exists()


def test_interrupted_dpkg_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    apt = tmp_path / "apt-get"
    apt.write_text("#!/bin/sh\necho 'E: dpkg was interrupted'\nexit 100\n")
    apt.chmod(0o755)
    (tmp_path / "updates").mkdir()
    (tmp_path / "updates" / "0001").touch()
    monkeypatch.setattr(system, "DPKG_UPDATES", tmp_path / "updates")
    monkeypatch.setattr(system, "_root_prefix", list)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert not system.install(plan("", NOBLE), tmp_path / "log")
    assert "`sudo dpkg --configure -a`, then `python3 launch_scripts/setup --system`" in capsys.readouterr().err


def test_a_browser_for_the_tests_is_asked_for_on_debian_where_there_is_none() -> None:
    assert system.browser_plan(None, BOOKWORM).packages == ["chromium-headless-shell"]
    assert system.browser_plan("/usr/bin/chromium", BOOKWORM).packages == []
    assert system.browser_plan(None, NOBLE).packages == []  # a snap there, which does not see temporary folders
