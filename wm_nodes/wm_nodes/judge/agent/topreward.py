"""TOPReward (RA-26): how probable "True" is after the statement that the clip completes its task.

r = log p("True" | frames, statement): one token of one answer per clip, without planning, votes or gates. The reward is
p("True") / (p("True") + p("False")), which lies in [0, 1]; where both words together are improbable, there is none.
The paper scores the bare text and gives a chat template as an option; a chat server always lays its template around it.
"""

import hashlib
from collections.abc import Sequence

from wm_nodes.judge.agent.judge import MediaItem, Vote
from wm_nodes.judge.agent.profiles import cited_media, uniform
from wm_nodes.judge.agent.types import NUM_LEVELS, ClipRef

MODE = "topreward"
WORDS = ("False", "True")
"""The answers, worst first."""
NUM_FRAMES = 16
"""Of a clip that the model sees, evenly spaced."""
SYSTEM = "Answer with one word, True or False, and nothing else."
STATEMENT = (
    "The above frames show a robot manipulation trajectory that completes the following task: {instruction}\n"
    "Decide whether the above statement is True or not. The answer is:"
)
VERSION = f"{MODE}-1-{hashlib.sha256((SYSTEM + STATEMENT).encode()).hexdigest()[:12]}"
"""In the place of a rubric's version: differs whenever a word does."""


def vote(seed: int) -> Vote:
    """The one read of a clip."""
    return Vote(0, "truth", "positive", seed)


def shown_frames(clip: ClipRef, most: int) -> tuple[MediaItem, ...]:
    """The frames of the read, in time order; `most` of them or fewer."""
    return cited_media(tuple(uniform(len(clip.frames), min(NUM_FRAMES, most))), clip)


def levels_of(probabilities: Sequence[float]) -> tuple[float, ...]:
    """The probabilities of WORDS as a distribution over levels: False is the worst, True the best."""
    false, true = probabilities
    return (false, *(0.0,) * (NUM_LEVELS - 2), true)
