"""A benchmark set of the toy that pushes a box, on disk: two episodes, all of them test clips."""

from pathlib import Path

from pushed_box import push_clip, redrawn

from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.generator import children
from wm_nodes.judge.dataset.edits.manifest import Division, Manifest, manifest_of, to_bytes
from wm_nodes.judge.dataset.set_files import MANIFEST, clip_path, to_file

NAMES = ("blur", "freeze", "ghost_motion", "occlude_patch", "flatten", "object_vanish", "dark")


def write_toy_set(folder: Path) -> Manifest:
    """An episode that succeeds and one that does not, each with the mild and failing versions of NAMES."""
    clips: list[LabelledClip] = []
    for seed, behaviour in enumerate(("expert", "short")):
        root = push_clip(behaviour, seed)
        clips += [root, *children(root, 0, redrawn, names=NAMES)]
    for clip in clips:
        target = clip_path(folder, clip.sha256)
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(to_file(clip))
    manifest = manifest_of(clips, Division(scenes=("gravel",)))
    (folder / MANIFEST).write_bytes(to_bytes(manifest))
    return manifest
