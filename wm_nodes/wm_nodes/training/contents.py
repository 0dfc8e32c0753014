"""What the files and folders hold that a run names by their paths, so that they can be moved between two starts."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wm_nodes.core.files import file_sha256
from wm_nodes.core.model_folder import MANIFEST

NAMED_BY = (MANIFEST, "metadata.yaml")
"""Files that stand for their folder: the manifest of a model, with the sha256 of each of its files, and the metadata of
a recording, with its files, times and counts."""


@dataclass(frozen=True)
class Contents:
    """What lay at the paths that a run names, when it first named them."""

    kept: Mapping[str, str] = field(default_factory=dict)
    """Hash of what lay there by absolute path, see content_of."""

    def of(self, path: str) -> str:
        """What was kept of a path, else what lies there now; empty where neither is known."""
        return self.kept.get(path) or content_of(path)

    def were_moved(self, old: Any, new: Any) -> bool:
        """Whether two values are as many paths each, and each new one is the old one or holds the same.

        Where nothing was kept of an old path and nothing lies there now, nobody can tell, and it was not.
        """
        before, now = paths_in(old), paths_in(new)
        return 0 < len(before) == len(now) and all(
            path == other or (self.of(path) != "" and self.of(path) == content_of(other))
            for path, other in zip(before, now, strict=True)
        )

    def with_paths(self, values: Any, folder: Path) -> "Contents":
        """Those of all paths in a run's settings and options that lie outside of its folder."""
        found = {path: self.of(path) for path in _all_paths(values) if not Path(path).is_relative_to(folder)}
        return Contents({path: content for path, content in found.items() if content})


def content_of(path: str) -> str:
    """The sha256 of a file, or of the one that stands for a folder (NAMED_BY); empty where there is none to be read."""
    for file in (Path(path), *(Path(path, name) for name in NAMED_BY)):
        with suppress(OSError):
            if file.is_file():  # not a robot's port, which could be waited for without end
                return file_sha256(file)
    return ""


def paths_in(value: Any) -> list[str]:
    """The absolute paths in a value: one, several in a text with commas between them, or a list of them; empty where
    anything else is in it."""
    texts = value.split(",") if isinstance(value, str) else value if isinstance(value, (list, tuple)) else []
    return [*texts] if all(isinstance(text, str) and Path(text).is_absolute() for text in texts) else []


def _all_paths(values: Any) -> Iterator[str]:
    if isinstance(values, Mapping):
        for value in values.values():
            yield from _all_paths(value)
    elif not isinstance(values, Sequence) or isinstance(values, str) or paths_in(values):
        yield from paths_in(values)
    else:
        for value in values:
            yield from _all_paths(value)
