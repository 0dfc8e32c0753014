"""All evidence of a clip that the embedded judge reads. Specification: section 4.1. Shapes: T frames, H W 3 image."""

from wm_nodes.reward.evidence.motion import motion_evidence
from wm_nodes.reward.evidence.objects import object_evidence, scene_of
from wm_nodes.reward.evidence.pictures import pictures_of
from wm_nodes.reward.evidence.pixels import pixel_evidence
from wm_nodes.reward.evidence.regions import region_evidence
from wm_nodes.reward.evidence.segmentation import Segmenter
from wm_nodes.types import UInt8Array


def clip_evidence(
    segmenter: Segmenter, frames: UInt8Array, reference: UInt8Array, instruction: str
) -> dict[str, float]:
    """Return every number of definitions.EVIDENCE but the model's, each finite.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2. reference: uint8 (H, W, 3), what the clip had to start from.
        instruction: names the object's colour first, then the target's.

    Raises:
        ValueError: wrong shapes or types; names them.
    """
    pictures = pictures_of(frames, reference)
    masks = segmenter.masks(pictures.colours)
    scene = scene_of(masks)
    return {
        **pixel_evidence(pictures),
        **object_evidence(scene, reference, instruction),
        **motion_evidence(scene, pictures.colours),
        **region_evidence(pictures, masks, instruction),
    }
