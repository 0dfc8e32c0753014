"""An append-only file of JSON lines that cannot be changed unseen.

    {"body": ..., "hash": SHA-256 of the line without it, "kind": ..., "line": 1, 2, ..., "previous": hash of line - 1}

Every line is written whole in one go; a crash can only tear the last one. One process writes at a time. What a chain
cannot show is that its end was cut off at a line break: keep the head (hash of the last line) elsewhere for that.
"""

import fcntl
import hashlib
import json
import os
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any

FORMAT = "reward-audit-1"
FILE_NAME = "log.jsonl"
LOCK_NAME = "lock"
NO_LINE = "0" * 64
"""What line 1 follows."""
MIN_SECRET = 8
"""Characters of the shortest key that is looked for in texts; a shorter one may be a word of theirs."""
_SECRET_NAME = re.compile(r"(^|_)(API_?KEY|KEY|TOKEN|SECRET|PASSWORD|PASSWD)($|_)", re.IGNORECASE)
_SECRET_TEXT = re.compile(r"(?i:bearer\s+)[^\s\"']{8,}|\bsk-[A-Za-z0-9_-]{8,}")


class AuditError(ValueError):
    """A log that is damaged, in use, of another version, or does not hold what is asked for."""


@dataclass(frozen=True)
class Entry:
    """A line that is as it was written."""

    number: int
    """From 1."""
    kind: str
    """What it holds, see entries.py."""
    body: Mapping[str, Any]
    """JSON values."""
    hash: str
    """SHA-256 of the line without it."""


@dataclass(frozen=True)
class Fault:
    """What is wrong with a line."""

    number: int
    """From 1."""
    what: str
    """In words."""
    start: int
    """Byte of the file where it begins."""
    torn: bool = False
    """A crash did it, nothing comes after."""

    def __str__(self) -> str:
        return f"line {self.number}: {self.what}"


class AuditLog:
    """Writes a log; created where there is none. Use it in a `with`, or close it.

    Raises:
        AuditError: another process writes it, or its last line is torn or not a line of such a log.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._guard = threading.Lock()
        self._lock = lock_folder(self.folder)
        try:
            self._file = open(self.folder / FILE_NAME, "ab", buffering=0)  # noqa: SIM115
            self._size = self._file.tell()
            self.num_lines, self.head = _read_tail(self.folder / FILE_NAME) if self._size else (0, NO_LINE)
            if not self._size:
                self.append("log", {"format": FORMAT, "created": datetime.now(UTC).isoformat(timespec="seconds")})
        except BaseException:
            self._lock.close()
            raise

    def __enter__(self) -> "AuditLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def append(self, kind: str, body: Mapping[str, Any], *, sync: bool = False) -> int:
        """Write one line and return its number. A process that dies later cannot take it back.

        Args:
            body: of JSON values; secrets in its texts are replaced, and their names listed in `redacted`.
            sync: return only when it is on the disk, with all lines before it.

        Raises:
            OSError: e.g. a full disk; the file is as it was before. AuditError: the log is closed.
        """
        clean, names = redact(body)
        data = canonical_json({**clean, "redacted": names} if names else clean)
        with self._guard:
            if self._file.closed:
                raise AuditError(f"{self.folder} is closed; open it again to write a {kind}")
            data, digest = _make_line(self.num_lines + 1, self.head, kind, data)
            try:
                _write_all(self._file, data)
            except OSError as error:
                os.ftruncate(self._file.fileno(), self._size)
                text = f"cannot write {self.folder / FILE_NAME}: {error.strerror}; free some space there"
                raise OSError(error.errno, text) from error
            self._size += len(data)
            self.num_lines, self.head = self.num_lines + 1, digest
            if sync:
                os.fsync(self._file.fileno())
            return self.num_lines

    def close(self) -> None:
        """Let the next process write."""
        if not self._file.closed:
            os.fsync(self._file.fileno())
            self._file.close()
            self._lock.close()


def read_lines(folder: Path) -> Iterator[Entry]:
    """The lines of a log, each checked against the one before. Raises AuditError: the first fault; another format."""
    for entry in _check_lines(Path(folder) / FILE_NAME):
        if isinstance(entry, Fault):
            remedy = "run `recover`" if entry.torn else "run `verify` for all faults, and take a copy from before"
            raise AuditError(f"{Path(folder) / FILE_NAME}, {entry}; {remedy}")
        yield entry


def faults(folder: Path) -> list[Fault]:
    """All that is wrong with a log's lines, in order; empty for a whole one. Raises AuditError: there is no log."""
    return [entry for entry in _check_lines(Path(folder) / FILE_NAME) if isinstance(entry, Fault)]


def recover(folder: Path) -> str:
    """Cut off what a crash left of the last line, keep it beside the log, note that in the log. Returns what was done.

    Raises:
        AuditError: the log is in use, or faulty anywhere but at its end: nothing is touched then.
    """
    path = Path(folder) / FILE_NAME
    with lock_folder(Path(folder)):
        problems = faults(folder)
        if not problems:
            return "nothing to recover: every line is whole"
        if solid := [fault for fault in problems if not fault.torn]:
            raise AuditError(f"{path} was not torn by a crash but changed: " + "; ".join(map(str, solid)))
        data, start = path.read_bytes(), problems[0].start
        rest = data[start:]
        digest = hashlib.sha256(rest).hexdigest()
        saved = path.with_name(f"torn-{problems[0].number}-{digest[:8]}.bin")
        saved.write_bytes(rest)
        with open(path, "r+b") as file:
            file.truncate(start)
            os.fsync(file.fileno())
    with AuditLog(folder) as log:
        number = log.append("recovered", {"bytes": len(rest), "sha256": digest, "file": saved.name}, sync=True)
    return f"cut {len(rest)} bytes of line {problems[0].number} off, kept them in {saved.name}, noted in line {number}"


def redact(value: Any) -> tuple[Any, list[str]]:
    """The value with every secret in its texts replaced, and the names of those found.

    A secret is the value of an environment variable that is named like one (..._KEY, TOKEN, PASSWORD) and has 8
    characters or more, a bearer token, or a key that begins with sk-.
    """
    known = _known_secrets()
    names: set[str] = set()

    def clean(item: Any) -> Any:
        if isinstance(item, str):
            for text, name in known.items():
                if text in item:
                    names.add(name)
                    item = item.replace(text, f"[{name}]")
            if _SECRET_TEXT.search(item):
                names.add("bearer token or key")
                item = _SECRET_TEXT.sub("[secret]", item)
            return item
        if isinstance(item, Mapping):
            return {clean(key): clean(entry) for key, entry in item.items()}
        return [clean(entry) for entry in item] if isinstance(item, (list, tuple)) else item

    return clean(value), sorted(names)


def lock_folder(folder: Path) -> IO[str]:
    """Hold the folder's lock until the returned file is closed. Raises AuditError: another process holds it."""
    file = open(folder / LOCK_NAME, "a+", encoding="utf-8")  # noqa: SIM115  (closing it is giving the lock back)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read().strip() or "unknown"
        file.close()
        raise AuditError(f"{folder} is being written by process {owner}; wait for it, or take another folder") from None
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file


def canonical_json(value: Any) -> bytes:
    """JSON with sorted keys and nothing that can be written in two ways."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _make_line(number: int, previous: str, kind: str, body: bytes) -> tuple[bytes, str]:
    """A line in canonical JSON, and its hash. body: canonical JSON."""
    before = b'{"body":' + body
    after = b"," + canonical_json({"kind": kind, "line": number, "previous": previous})[1:]
    digest = hashlib.sha256(before + after).hexdigest()
    return before + b',"hash":"' + digest.encode() + b'"' + after + b"\n", digest


@cache
def _is_secret_name(name: str) -> bool:
    return bool(_SECRET_NAME.search(name))


def _known_secrets() -> dict[str, str]:
    """Value to name, of the environment as it is now."""
    names = [name for name in os.environ if _is_secret_name(name)]
    return {os.environ[name]: name for name in names if len(os.environ[name]) >= MIN_SECRET}


def _write_all(file: IO[bytes], data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def _check_lines(path: Path) -> Iterator[Entry | Fault]:
    """Every line as an Entry or, where something is wrong, a Fault."""
    if not path.is_file():
        raise AuditError(f"{path} does not exist; name the folder of an audit log")
    torn: list[Fault] = []
    start, expected, previous = 0, 1, str(NO_LINE)
    with open(path, "rb") as file:
        for number, raw in enumerate(file, 1):
            entry, expected, previous = _parse(raw, number, start, expected, previous)
            start += len(raw)
            if isinstance(entry, Fault) and entry.torn:
                torn.append(entry)
                continue
            yield from (replace(fault, torn=False) for fault in torn)  # a whole line behind it: no crash did that
            torn = []
            yield entry
    yield from torn


def _parse(raw: bytes, number: int, start: int, expected: int, previous: str) -> tuple[Entry | Fault, int, str]:
    """The line or its first fault, and which line should follow: its number and whose hash it names, "" if unknown."""
    try:
        line = json.loads(raw)
        kind, body, digest = str(line["kind"]), dict(line["body"]), str(line["hash"])
        stated, follows = int(line["line"]), line["previous"]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        what = f"{len(raw)} bytes that are no line of an audit log"
        return Fault(number, what, start, torn=True), expected + 1, ""
    about, after = f"a {kind} line", stated + 1
    if not raw.endswith(b"\n"):
        return Fault(number, f"{about} without its line end", start, torn=True), after, digest
    if raw != canonical_json(line) + b"\n" or not _is_whole(raw):
        return Fault(number, f"{about}: its text was changed after it was written", start), after, digest
    if stated != expected or (previous and follows != previous):
        other = f"it follows another line than line {number - 1}"
        gap = f"it says it is line {stated}" if stated != expected else other
        return Fault(number, f"{about}: {gap}; lines were removed, added, swapped or replaced", start), after, digest
    if number == 1 and (kind != "log" or body.get("format") != FORMAT):
        return Fault(number, f"{about}: this is no {FORMAT} log but {body.get('format')!r}", start), after, digest
    return Entry(stated, kind, body, digest), after, digest


def _is_whole(raw: bytes) -> bool:
    """Whether a line is what its own hash says, wherever it stands."""
    try:
        line = json.loads(raw)
        digest = line.pop("hash")
        return raw.endswith(b"\n") and hashlib.sha256(canonical_json(line)).hexdigest() == digest
    except (ValueError, KeyError, TypeError, AttributeError):
        return False


def _read_tail(path: Path) -> tuple[int, str]:
    """Number and hash of the last line."""
    with open(path, "rb") as file:
        file.seek(0, os.SEEK_END)
        size, block = file.tell(), b""
        while block.count(b"\n") < 2 and len(block) < size:
            step = min(size - len(block), 1 << 16)
            file.seek(size - len(block) - step)
            block = file.read(step) + block
    last: Sequence[bytes] = block.splitlines(keepends=True)
    if not last or not _is_whole(last[-1]):
        raise AuditError(f"{path} ends in a torn line; run `wm audit recover {path.parent}`")
    line = json.loads(last[-1])
    return int(line["line"]), str(line["hash"])
