"""A content-addressed cache of reads on disk.

The key covers everything that the answer depends on: media, prompt with its options, rubric, model, transport. With it
reruns are bit-equal, which live servers do not guarantee.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from wm_nodes.core.files import write_atomic
from wm_nodes.judge.agent.judge import Read
from wm_nodes.judge.agent.types import Status

_READS = TypeAdapter(tuple[Read, ...])


def cache_key(media_sha: str, prompt_sha: str, rubric_version: str, model: str, transport: str) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(json.dumps([media_sha, prompt_sha, rubric_version, model, transport]).encode()).hexdigest()


class VerdictCache:
    """Reads by key, one JSON file each, written whole or not at all; several processes may share a folder.

    Reads with status ERROR are never stored.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def get(self, key: str) -> tuple[Read, ...] | None:
        """The reads, or None where there are none or the file cannot be read (it is written anew then)."""
        try:
            return _READS.validate_json(self._path(key).read_bytes())
        except (FileNotFoundError, ValidationError):
            return None

    def put(self, key: str, reads: Sequence[Read]) -> None:
        if any(read.status is Status.ERROR for read in reads):
            return
        write_atomic(self._path(key), _READS.dump_json(tuple(reads)), flush=False)

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"
