"""Files that a peer names: where they may lie, what they may be, how large, and how long a read may take."""

import ctypes
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from deadlines import within

from wm_nodes.core.named_files import (
    RUBRIC,
    WEIGHTS,
    FileKind,
    FileRefused,
    NamedFiles,
    OutsideFolders,
    read_regular,
)

SMALL = FileKind("a small file", 1 << 20)
MS_DETACH = 2


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "inside.txt").write_bytes(b"inside")
    (tmp_path / "secret.txt").write_bytes(b"secret")
    return folder


def test_relative_absolute_and_linked_names_inside_are_read(run: Path, tmp_path: Path) -> None:
    files = NamedFiles(run)
    (run / "link").symlink_to("inside.txt")
    (tmp_path / "alias").symlink_to(run)
    for name in ("inside.txt", str(run / "inside.txt"), "link", "a/../inside.txt", f"{tmp_path}/alias/inside.txt"):
        assert files.read(name, SMALL) == b"inside", name
    through_link = NamedFiles(tmp_path / "alias")
    assert through_link.read(str(run / "inside.txt"), SMALL) == through_link.read("inside.txt", SMALL) == b"inside"


def test_a_run_folder_that_is_named_from_the_working_folder_is_found(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    files = NamedFiles(Path("run"))
    monkeypatch.chdir("/")
    assert files.read("inside.txt", SMALL) == b"inside"


def test_what_lies_outside_is_refused_in_the_same_words_whether_it_exists_or_not(run: Path, tmp_path: Path) -> None:
    files = NamedFiles(run)
    (run / "out").symlink_to(tmp_path)
    (run / "to_file").symlink_to(tmp_path / "secret.txt")
    for there, missing in (("../secret.txt", "../absent.txt"), ("out/secret.txt", "out/absent.txt"),
                           (str(tmp_path / "secret.txt"), str(tmp_path / "absent.txt")),
                           (f"{run}x", f"{run}y"), ("to_file", "out/../../absent"), ("/dev/zero", "/dev/none")):
        said = set()
        for name in (there, missing):
            for ask in (lambda n: files.read(n, SMALL), files.path, files.readable, lambda n: files.new(n, "bags")):
                with pytest.raises(OutsideFolders) as refused:
                    ask(name)
                said.add(str(refused.value).replace(repr(name), "NAME"))
        assert len(said) == 1, said
        assert "allowed_dirs:=FOLDER" in said.pop()


def test_an_allowed_folder_and_an_allowed_file_are_open_and_their_neighbours_are_not(run: Path, tmp_path: Path) -> None:
    more = tmp_path / "more"
    more.mkdir()
    (more / "a").write_bytes(b"a")
    files = NamedFiles(run, [more, tmp_path / "secret.txt"])
    assert files.read(str(more / "a"), SMALL) == b"a"
    assert files.read("../secret.txt", SMALL) == b"secret"
    assert files.new(str(more / "new"), "bags") == more / "new"
    for name in ("../secret.txt.partial", "../more2"):
        with pytest.raises(OutsideFolders):
            files.path(name)
    for name in (str(more), "../secret.txt", "."):  # temporary names would lie beside it
        with pytest.raises(OutsideFolders):
            files.new(name, "bags")
    nothing = NamedFiles(None, [more])
    assert nothing.read(str(more / "a"), SMALL) == b"a"
    with pytest.raises(OutsideFolders):
        nothing.path("here")


@pytest.mark.parametrize(
    "name", ["", "~", "~/x", "~root/x", "a\0b", "a\nb", "a\u2028b", "a\udc80b", "x" * 256, "a/" * 3000, "é" * 200]
)
def test_what_is_no_name_is_refused_on_one_short_line(run: Path, name: str) -> None:
    files = NamedFiles(run)
    for ask in (lambda: files.read(name, SMALL), lambda: files.path(name), lambda: files.new(name, "bags")):
        with pytest.raises(FileRefused, match="is no name of a file; give a path") as refused:
            ask()
        assert len(str(refused.value).splitlines()) == 1 and len(str(refused.value)) < 400
        str(refused.value).encode()


def test_only_regular_files_within_the_limit_are_read_and_nothing_waits(run: Path) -> None:
    files = NamedFiles(run)
    os.mkfifo(run / "fifo")
    (run / "folder").mkdir()
    special = ["fifo", "folder"]
    if os.geteuid() == 0:
        os.mknod(run / "zero", 0o666 | 0o020000, os.makedev(1, 5))
        special.append("zero")
    began = time.monotonic()
    for name in special:
        with pytest.raises(FileRefused, match="is no regular file; name a file that holds weights"):
            files.read(name, WEIGHTS)
        with pytest.raises(FileRefused, match="is no regular file"):
            read_regular(run / name, WEIGHTS)
    for size, fits in ((1 << 20, True), ((1 << 20) + 1, False)):
        with open(run / "sparse", "wb") as file:
            file.truncate(size)
        if fits:
            assert files.read("sparse", RUBRIC) == bytes(size)
        else:
            with pytest.raises(FileRefused, match="'sparse' is larger than the 1 MiB a rubric pack may have"):
                files.read("sparse", RUBRIC)
    with pytest.raises(FileNotFoundError):
        files.read("absent", WEIGHTS)
    assert time.monotonic() - began < within(5)


def test_a_file_that_hides_its_size_is_read_up_to_the_limit() -> None:
    endless = NamedFiles(None, ["/proc/self"])
    assert b"\n" in endless.read("/proc/self/maps", SMALL)
    with pytest.raises(FileRefused, match="is larger than the 0 MiB"):
        endless.read("/proc/self/maps", FileKind("maps", 10))


def test_a_folder_is_refused_for_a_link_that_leads_out_of_it_and_for_a_fifo_in_it(run: Path, tmp_path: Path) -> None:
    files = NamedFiles(run)
    bag = run / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("")
    assert files.readable("bag") == bag and files.readable("no_such_bag") == run / "no_such_bag"
    (bag / "bag_0.mcap").symlink_to(tmp_path / "secret.txt")
    with pytest.raises(OutsideFolders):
        files.readable("bag")
    (bag / "bag_0.mcap").unlink()
    os.mkfifo(bag / "bag_0.mcap")
    with pytest.raises(FileRefused, match="is no regular file"):
        files.readable("bag")


def test_what_belongs_to_the_run_is_no_place_for_anything_new(run: Path) -> None:
    files = NamedFiles(run)
    taken = ("policies/policy_000027.safetensors", "config.yaml", "bags", "bags.json", "checkpoints/x", "a/../data/x")
    for name in taken:
        with pytest.raises(FileRefused, match="belongs to the run itself; take bags/NAME, or a new folder"):
            files.new(name, "bags")
    for name in ("bags/mine", "mine", "mine/bag"):
        assert files.new(name, "bags") == run / name


def swap(path: Path, other: Path, stop: threading.Event) -> None:
    """Put `other` in the place of `path` and back, for ever."""
    kept = path.with_name("kept")
    while not stop.is_set():
        path.rename(kept)
        path.symlink_to(other)
        path.unlink()
        kept.rename(path)


@pytest.mark.parametrize("name", ["file", "folder"])
def test_a_file_or_folder_that_is_swapped_for_a_link_meanwhile_never_leads_outside(
    run: Path, tmp_path: Path, name: str
) -> None:
    (run / "folder").mkdir()
    (run / "folder" / "file").write_bytes(b"inside")
    (tmp_path / "file").write_bytes(b"secret")
    path, other = (run / "folder" / "file", tmp_path / "file") if name == "file" else (run / "folder", tmp_path)
    stop = threading.Event()
    thread = threading.Thread(target=swap, args=(path, other, stop))
    thread.start()
    seen = {b"inside": 0, b"refused": 0}
    try:
        files, until = NamedFiles(run), time.monotonic() + 1
        while time.monotonic() < until or not all(seen.values()):
            try:
                seen[files.read("folder/file", SMALL)] += 1
            except (FileRefused, OSError):
                seen[b"refused"] += 1
            assert time.monotonic() < until + 20
    finally:
        stop.set()
        thread.join()
    assert set(seen) == {b"inside", b"refused"}


@pytest.fixture
def dead_disk(tmp_path: Path) -> Iterator[Path]:
    """A mounted file system that answers nothing, like a network's whose server is gone."""
    mount = ctypes.CDLL(None, use_errno=True).mount
    try:
        device = os.open("/dev/fuse", os.O_RDWR)
    except OSError as error:
        pytest.skip(f"no /dev/fuse here: {error}")
    folder = tmp_path / "dead"
    folder.mkdir()
    options = f"fd={device},rootmode=40000,user_id=0,group_id=0".encode()
    if mount(b"dead", bytes(folder), b"fuse", 0, options):
        os.close(device)
        pytest.skip(f"mounting is not allowed here: {os.strerror(ctypes.get_errno())}")
    yield folder
    ctypes.CDLL(None).umount2(bytes(folder), MS_DETACH)
    os.close(device)  # ends the waiting calls


def test_a_file_system_that_does_not_answer_gives_an_error_after_the_deadline(run: Path, dead_disk: Path) -> None:
    asks: list[Callable[[NamedFiles], object]] = [
        lambda files: files.read(str(dead_disk / "x"), SMALL), lambda files: files.readable(str(dead_disk / "x")),
        lambda files: files.new(str(dead_disk / "x"), "bags"),
    ]
    for ask in asks:
        began = time.monotonic()
        with pytest.raises(FileRefused, match=r"x' cannot be read: no answer for 0\.3 s; is its disk there\?"):
            ask(NamedFiles(run, [dead_disk], stall_s=0.3))
        assert 0.25 < time.monotonic() - began < within(3)
        with pytest.raises(OutsideFolders):
            ask(NamedFiles(run, stall_s=0.3))
    assert NamedFiles(run, [dead_disk], stall_s=5).read("inside.txt", SMALL) == b"inside"


def test_reads_that_hang_do_not_add_up_without_end(run: Path, dead_disk: Path) -> None:
    files = NamedFiles(run, [dead_disk], stall_s=0.01)
    said = set[str]()
    for _ in range(40):
        with pytest.raises(FileRefused) as refused:
            files.read(str(dead_disk / "x"), SMALL)
        said.add(str(refused.value))
    assert any("too many reads hang already" in text for text in said)
    assert sum(thread.name == "named file" for thread in threading.enumerate()) <= 16
