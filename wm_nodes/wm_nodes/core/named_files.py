"""Files that somebody else names, in a message, a request or a goal: they must lie in the run folder or in a folder
that the user has allowed, and are read within a limit of size and time."""

import os
import re
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

STALL_S = 10.0
"""A read that brings nothing for so long is given up: the file system does not answer."""
CHUNK_BYTES = 16 << 20
_READERS = threading.BoundedSemaphore(16)
"""One for each read under way, also for those that were given up and still hang."""
_UNPRINTABLE = re.compile("[\0-\x1f\x7f\x85\u2028\u2029\ud800-\udfff]")
_MAX_NAME_BYTES, _MAX_PART_BYTES, _SHOWN = 4095, 255, 200

RUN_ENTRIES = frozenset((
    "acceptance.json", "audit", "bags", "bags.json", "buffers", "checkpoints",
    "composed.params.yaml", "config.yaml", "data", "evaluations", "judge_reads", "logs",
    "metrics.jsonl", "model", "pictures", "policies", "report.html", "rounds", "run.lock", "starts.json",
    "starts.safetensors", "summary.json", "tensorboard", "trained.json", "video_model",
    "video_policies",
))
"""What a run keeps in its folder under names of its own."""


@dataclass(frozen=True)
class FileKind:
    """name: for people. limit_bytes: a larger file is refused."""

    name: str
    limit_bytes: int


WEIGHTS = FileKind("weights", 8 << 30)
BUFFER = FileKind("a rollout buffer", 8 << 30)
CLIP = FileKind("a clip", 4 << 30)
PICTURE = FileKind("a picture", 64 << 20)
CLIP_LIST = FileKind("a list of clips", 64 << 20)
RUBRIC = FileKind("a rubric pack", 1 << 20)
CHECKPOINT = FileKind("a checkpoint", 1 << 20)


class FileRefused(ValueError):
    """A name that is not read or written: one line with the name and the remedy."""


class OutsideFolders(FileRefused):
    """A path outside of the run folder and the allowed folders; tells nothing of what is there."""


class NamedFiles:
    """The files that others may name to a node.

    Args:
        run_dir: relative names begin here; None: in the working folder, of which nothing is allowed.
        allowed: further folders, or single files, that the user has allowed.
        stall_s: see STALL_S.
    """

    def __init__(self, run_dir: Path | None, allowed: Iterable[str | Path] = (), stall_s: float = STALL_S) -> None:
        self._run_dir, self._stall_s = run_dir, stall_s
        self._base = Path(os.path.abspath(run_dir or ""))
        self._roots = [*([self._base] if run_dir else []), *(self._base / path for path in allowed)]

    def path(self, uri: str) -> Path:
        """The absolute path behind a name, links resolved. Nothing need be there.

        Raises:
            OutsideFolders: it lies elsewhere. FileRefused: no name of a file, or its file system does not answer.
        """
        self._check_name(uri)
        try:
            return self._within(uri, lambda beat: self._resolve(uri))
        except OutsideFolders:
            raise
        except FileRefused:
            self._check_inside(uri, Path(os.path.normpath(self._base / uri)), self._roots)
            raise

    def read(self, uri: str, kind: FileKind) -> bytes:
        """The bytes of a regular file.

        Raises:
            FileRefused: as path(); no regular file, larger than the kind's limit, or it cannot be read in time.
            OSError: there is none, or it may not be read.
        """
        path = self.path(uri)
        return self._within(uri, lambda beat: _read(path, kind, uri, beat))

    def readable(self, uri: str) -> Path:
        """The path of a file, or of a folder of files such as a bag, for a reader of its own. Nothing need be there.

        Raises:
            FileRefused: as path(); a link in the folder leads outside, or something there is no regular file.
        """
        path = self.path(uri)

        def check(beat: Callable[[], None]) -> None:
            for entry in (path, *path.iterdir()) if path.is_dir() else (path,):
                with suppress(FileNotFoundError, NotADirectoryError):
                    mode = os.stat(self._resolve(str(entry))).st_mode
                    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                        raise FileRefused(f"{shown(str(entry))} is no regular file; name files, or a folder of files")

        self._within(uri, check)
        return path

    def new(self, uri: str, home: str) -> Path:
        """Where a file or folder may be written, with temporary names beside it.

        Args:
            home: what the run folder has for things of this kind, e.g. bags.

        Raises:
            FileRefused: as path(); or the name belongs to the run itself.
        """
        path = self.path(uri)
        self._check_inside(uri, path.parent, self._real_roots())
        if self._run_dir is None or not path.is_relative_to(base := os.path.realpath(self._base)):
            return path
        inside = path.relative_to(base)
        if inside.parts[0] in RUN_ENTRIES and (inside.parts[0] != home or len(inside.parts) < 2):
            raise FileRefused(f"{shown(uri)} belongs to the run itself; take {home}/NAME, or a new folder")
        return self._run_dir / inside

    def _check_name(self, uri: str) -> None:
        sizes = [len(part.encode(errors="replace")) for part in uri.split("/")]
        too_long = max(sizes) > _MAX_PART_BYTES or sum(sizes) + len(sizes) > _MAX_NAME_BYTES
        if not uri or uri.startswith("~") or too_long or _UNPRINTABLE.search(uri):
            raise FileRefused(
                f"{shown(uri)} is no name of a file; give a path, absolute or relative to the run folder, without ~"
            )

    def _resolve(self, uri: str) -> Path:
        path = Path(os.path.realpath(self._base / uri))
        self._check_inside(uri, path, self._real_roots())
        return path

    def _real_roots(self) -> Iterator[Path]:
        """One by one: a dead disk among the later ones must not keep the earlier ones from being found."""
        return (Path(os.path.realpath(root)) for root in self._roots)

    def _check_inside(self, uri: str, path: Path, roots: Iterable[Path]) -> None:
        if not any(path.is_relative_to(root) for root in roots):
            raise OutsideFolders(
                f"{shown(uri)} lies outside of the run folder and of allowed_dirs; copy it into the run folder, or "
                "start the graph with allowed_dirs:=FOLDER"
            )

    def _within(self, uri: str, work: Callable[[Callable[[], None]], T]) -> T:
        """Return work(beat), done in a thread that is given up when it neither ends nor calls beat for stall_s."""
        if not _READERS.acquire(blocking=False):
            raise FileRefused(f"{shown(uri)} is not read: too many reads hang already; look after that file system")
        done, results, errors, beats = threading.Event(), list[T](), list[BaseException](), [time.monotonic()]

        def run() -> None:
            try:
                results.append(work(lambda: beats.append(time.monotonic())))
            except BaseException as error:
                errors.append(error)
            finally:
                _READERS.release()
                done.set()

        threading.Thread(target=run, name="named file", daemon=True).start()
        while not done.wait(max(0.0, beats[-1] + self._stall_s - time.monotonic())):
            if time.monotonic() >= beats[-1] + self._stall_s:
                raise FileRefused(f"{shown(uri)} cannot be read: no answer for {self._stall_s:g} s; is its disk there?")
        if errors:
            raise errors[0]
        return results[0]


def read_regular(path: Path, kind: FileKind) -> bytes:
    """The bytes of a regular file that the user himself names. Raises as NamedFiles.read, except for place and time."""
    return _read(Path(os.path.realpath(path)), kind, str(path), lambda: None)


def shown(name: str) -> str:
    """A name in quotes, on one line and not too long."""
    text = repr(name)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...'"


def _read(path: Path, kind: FileKind, uri: str, beat: Callable[[], None]) -> bytes:
    descriptor = _open(path)
    try:
        status, limit, chunks, size = os.fstat(descriptor), kind.limit_bytes, list[bytes](), 0
        if not stat.S_ISREG(status.st_mode):
            raise FileRefused(f"{shown(uri)} is no regular file; name a file that holds {kind.name}")
        if status.st_size <= limit:  # some files say 0 and hold more
            while size <= limit and (chunk := os.read(descriptor, min(CHUNK_BYTES, limit + 1 - size))):
                chunks.append(chunk)
                size += len(chunk)
                beat()
        if max(status.st_size, size) > limit:
            raise FileRefused(f"{shown(uri)} is larger than the {limit >> 20} MiB {kind.name} may have; name another")
        return b"".join(chunks)
    finally:
        os.close(descriptor)


def _open(path: Path) -> int:
    """Open a resolved absolute path, and nothing that a link has put in its place since. Never waits for a writer."""
    folder = os.open("/", os.O_PATH | os.O_DIRECTORY)
    try:
        for part in path.parts[1:-1]:
            below = os.open(part, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=folder)
            os.close(folder)
            folder = below
        return os.open(path.name or ".", os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    finally:
        os.close(folder)
