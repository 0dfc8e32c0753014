"""Pictures of a policy's episodes beside what the world model imagines of them."""

import numpy as np
import pytest

from wm_nodes.apps.policy_pictures import side_by_side
from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.specs import SOURCE_SIMULATOR
from wm_nodes.core.types import Episode
from wm_nodes.world_model import load_model_folder


@pytest.mark.parametrize(
    ("instruction", "drawn"), [("push the blue cube into the red target", True), ("stir the soup", False)]
)
def test_a_goal_is_drawn_where_the_text_model_knows_the_words(instruction: str, drawn: bool) -> None:
    models = load_model_folder(shipped_model("push_cube"))
    spec = models.spec
    episode = Episode(
        images=np.full((3, spec.height, spec.width, 3), 128, np.uint8),
        states=np.tile(np.float32([0.6, 0.0, 0.1]), (3, 1)), actions=np.zeros((2, spec.action_dim), np.float32),
        ground_truth=np.zeros((3, len(spec.ground_truth_names)), np.float32), success=np.zeros(3, np.bool_),
        rewards=np.zeros(2, np.float32), terminated=False, truncated=True, task="push_cube", instruction=instruction,
        behaviour="policy", seed=0, episode_id=0, source=SOURCE_SIMULATOR,
    )
    pair = side_by_side(models, [episode], load_config("cpu", {"task": "push_cube"}))[0]
    assert (pair.goal is not None) == drawn and len(pair.imagined) == 3
