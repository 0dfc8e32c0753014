"""Planned episodes into one of our bags: pictures are decoded one by one as the bags stream past; in memory are those
of the episodes in progress."""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wm_nodes.config.load import dump_config
from wm_nodes.core.progress import tqdm
from wm_nodes.core.specs import SOURCE_REAL, EnvironmentSpec
from wm_nodes.core.types import TRY, Episode, UInt8Array
from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError
from wm_nodes.recording.imported.contract import Contract, Numbers
from wm_nodes.recording.imported.pictures import fitted, rgb_of
from wm_nodes.recording.imported.planning import PlannedEpisode
from wm_nodes.recording.imported.survey import Survey
from wm_nodes.recording.writer import EpisodeBagWriter


def spec_of_contract(contract: Contract, max_steps: int) -> EnvironmentSpec:
    """The spec of the episodes. max_steps: of the longest."""
    cameras, state, actions = contract.observations.images, contract.observations.state, contract.actions
    height, width = next(iter(cameras.values())).size
    said = contract.episodes.instruction
    return EnvironmentSpec(
        env_id=contract.robot, task=contract.task, instruction=said if isinstance(said, str) else "",
        source=SOURCE_REAL, num_envs=1, height=height, width=width * len(cameras), cameras=tuple(cameras),
        action_names=tuple(contract.action_names), action_units=tuple(_units(actions)),
        action_scale=tuple((high - low) / 2 for source in actions for low, high in zip(source.low, source.high)),
        state_names=tuple(contract.state_names), state_units=tuple(_units(state)),
        ground_truth_names=tuple(contract.probed_names),
        control_period_s=1 / contract.rate_hz, max_episode_steps=max_steps,
    )


def write(survey: Survey, folder: Path) -> tuple[int, list[str]]:
    """Write the planned episodes into a new bag; returns how many, and a line for each that a damaged picture cost.

    Raises:
        BagError: Survey.check refuses, or the folder exists. RecordingError: the disk is full.
    """
    survey.check()
    contract, damaged, number = survey.contract, list[str](), 0
    spec = spec_of_contract(contract, max(len(episode.actions) for episode in survey.episodes))
    custom = {"wm.contract_yaml": dump_config(contract), "wm.import_table": survey.table(),
              "wm.imported_bags": json.dumps([str(path) for path in survey.planned])}
    first_ns = max(1, int(survey.episodes[0].ticks[0]))
    with EpisodeBagWriter(folder, spec, run_id="import-rosbag", custom=custom, start_ns=first_ns) as writer:
        for path, planned in survey.planned.items():
            for episode, images in _with_pictures(path, planned, contract, damaged):
                writer.write(_episode(episode, images, contract, number, path))
                number += 1
        if not number:
            raise BagError(f"every episode has a damaged picture: {damaged[0]}; record again")
    return number, damaged


@dataclass
class _Filling:
    """The pictures of an episode in progress."""

    images: UInt8Array
    """(T + 1, H, W, 3), filled one by one."""
    left: int
    """Pictures of a camera that are still to come."""


def _with_pictures(
    path: Path, planned: list[PlannedEpisode], contract: Contract, damaged: list[str]
) -> Iterator[tuple[PlannedEpisode, UInt8Array]]:
    """Yield each episode when its last picture has come; those with a damaged one are named in `damaged` instead."""
    cameras = list(contract.observations.images.values())
    places: list[defaultdict[int, list[tuple[int, int]]]] = [defaultdict(list) for _ in cameras]
    for row, episode in enumerate(planned):
        for (frame, camera), number in np.ndenumerate(episode.pictures):
            places[camera][int(number)].append((row, frame))
    counts, open_, dropped = [0] * len(cameras), dict[int, _Filling](), set[int]()
    height, width = cameras[0].size
    by_topic = defaultdict[str, list[int]](list)
    for index, camera_ in enumerate(cameras):
        by_topic[camera_.topic].append(index)
    with Bag(path) as bag:
        for topic, _, data in tqdm(bag.messages(by_topic), f"{path.name}: pictures", sum(map(bag.count, by_topic))):
            for camera in by_topic[topic]:
                wanted = places[camera].pop(counts[camera], ())
                counts[camera] += 1
                if not wanted:
                    continue
                try:
                    picture = fitted(rgb_of(bag.decode(data, cameras[camera].type)), cameras[camera])
                except BagError as error:
                    rows = {row for row, _ in wanted} - dropped
                    damaged += [f"episode {row + 1} of {path.name}: {topic}: {error}" for row in sorted(rows)]
                    dropped |= rows
                    continue
                for row, frame in wanted:
                    if row in dropped:
                        open_.pop(row, None)
                        continue
                    if row not in open_:
                        shape = (len(planned[row].ticks), height, width * len(cameras), 3)
                        open_[row] = _Filling(np.zeros(shape, np.uint8), planned[row].pictures.size)
                    filling = open_[row]
                    filling.images[frame, :, camera * width : (camera + 1) * width] = picture
                    filling.left -= 1
                    if not filling.left:
                        yield planned[row], open_.pop(row).images


def _episode(planned: PlannedEpisode, images: UInt8Array, contract: Contract, number: int, path: Path) -> Episode:
    terminated = bool(planned.success[-1])
    return Episode(
        images=images, states=planned.states, actions=planned.actions,
        ground_truth=planned.probes, success=planned.success, rewards=planned.rewards,
        terminated=terminated, truncated=not terminated, task=contract.task, instruction=planned.instruction,
        behaviour=contract.episodes.behaviour, seed=number, episode_id=number, source=SOURCE_REAL,
        extra={"bag": path.name, "first_tick_ns": int(planned.ticks[0]), TRY: planned.try_number},
    )


def _units(sources: Sequence[Numbers]) -> list[str]:
    return [source.unit for source in sources for _ in source.select]
