"""Actions as tokens of a language model, as OpenVLA writes them. Shapes: B batch, A action.

For a vision-language-action policy behind `policy.factory`; ImagePolicy acts in real numbers and needs none. 256 edges,
equally spaced over [-1, 1], make 255 bins, and the last 256 ids of the vocabulary name them from the end.
"""

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.types import FloatArray

NUM_EDGES = 256
VOCABULARY = 32000
"""Real entries of Llama 2's vocabulary; OpenVLA's table is padded to 32064."""


class ActionTokenizer:
    """Normalised actions to token ids and back, within half a bin, 1/255.

    Args:
        vocabulary: real entries of the language model's vocabulary.
    """

    def __init__(self, vocabulary: int = VOCABULARY) -> None:
        self.vocabulary = vocabulary
        self._edges = np.linspace(-1.0, 1.0, NUM_EDGES)
        self._centres = ((self._edges[1:] + self._edges[:-1]) / 2).astype(np.float32)

    def encode(self, actions_BA: FloatArray) -> NDArray[np.int64]:
        """Token ids (B, A) of normalised actions; the id falls as the action grows. 1 is in the last bin: OpenVLA gives
        it an id of its own, which decodes as the last bin's.

        Raises:
            ValueError: an action outside [-1, 1], or not a number.
        """
        inside = np.abs(actions_BA) <= 1
        if not inside.all():
            raise ValueError(
                f"action {actions_BA[~inside].flat[0]:g} lies outside [-1, 1]; actions are normalised, divide by "
                "EnvSpec.action_scale"
            )
        bins_BA = np.digitize(actions_BA, self._edges).clip(max=NUM_EDGES - 1)
        ids: NDArray[np.int64] = self.vocabulary - bins_BA.astype(np.int64)
        return ids

    def decode(self, tokens_BA: NDArray[np.int64]) -> FloatArray:
        """Centres (B, A) of the bins that token ids name; ids of no action give the nearest bin, as in OpenVLA."""
        found: FloatArray = self._centres[np.clip(self.vocabulary - 1 - tokens_BA, 0, NUM_EDGES - 2)]
        return found
