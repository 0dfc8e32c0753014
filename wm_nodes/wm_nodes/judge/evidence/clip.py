"""All evidence of a clip that the embedded judge reads (RA-17). Shapes: T frames, H W 3 image."""

from collections.abc import Sequence

from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.evidence.motion import motion_evidence, outline_of
from wm_nodes.judge.evidence.objects import object_evidence, scene_of, target_of
from wm_nodes.judge.evidence.pictures import pictures_of
from wm_nodes.judge.evidence.pixels import pixel_evidence
from wm_nodes.judge.evidence.regions import region_evidence
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.evidence.sequence import ObjectSequence, TemporalNetwork, object_sequence, readings


def clip_evidence(
    segmenter: Segmenter, frames: UInt8Array, reference: UInt8Array, instruction: str,
    readers: Sequence[TemporalNetwork] = (),
) -> dict[str, float]:
    """Return every number of docs/embedded_judge_evidence.csv, and what the readers answer, each finite.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2. reference: uint8 (H, W, 3), what the clip had to start from.
        instruction: names the object's colour first, then the target's.

    Raises:
        ValueError: wrong shapes or types; names them.
    """
    numbers, sequence = measure_clip(segmenter, frames, reference, instruction)
    return {**numbers, **readings(readers, sequence)}


def measure_clip(
    segmenter: Segmenter, frames: UInt8Array, reference: UInt8Array, instruction: str
) -> tuple[dict[str, float], ObjectSequence]:
    """The numbers, and what a reader reads. Arguments and errors as those of clip_evidence."""
    pictures = pictures_of(frames, reference)
    masks = segmenter.masks(pictures.colours)
    scene = scene_of(masks)
    outline = outline_of(scene, pictures.colours)
    numbers = {
        **pixel_evidence(pictures), **object_evidence(scene, reference, instruction), **motion_evidence(scene, outline),
        **region_evidence(pictures, masks, instruction),
    }
    return numbers, object_sequence(scene, outline, pictures.colours, target_of(masks[0], reference, instruction))
