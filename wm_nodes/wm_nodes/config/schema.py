"""What every setting of loop 1 means and which values are allowed. The numbers live in presets/, not here.

Loop 2's are in video.py.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from wm_nodes.config.environments import EnvironmentConfig, GymnasiumConfig, ScenesName, SimulationConfig
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.measurement import AcceptanceConfig, EvaluationConfig, ExploitMeterConfig, ModelRefreshConfig
from wm_nodes.config.sections import (
    FactoryName,
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    SettingsSection,
)
from wm_nodes.config.tasks import check_task, instruction

AGENT = "agent"
"""Name of the reward agent among the rewards of both loops."""
EXECUTION = "execution"
"""Name of the reward of clips by an action world model, see video_rl/execution_reward.py."""

TaskName = Annotated[
    str, BeforeValidator(lambda name: name or ""), AfterValidator(lambda name: name and check_task(name))
]
"""Name of a task's file, see config/tasks.py. Empty: there is none, and `simulation` is not read; everything follows
the spec of the environment, of its recordings or of the model that was trained on them."""
PolicyInputs = Literal["latents", "positions", "both", "state"]
"""What a policy sees of a picture, see PolicyConfig.inputs."""
DeviceName = Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
"""Where models compute: cpu, cuda, cuda:N, or auto (a GPU where there is one), see core/device.py."""


def _with_a_share(behaviours: dict[str, float]) -> dict[str, float]:
    if not 0 < sum(behaviours.values()) < math.inf:
        raise ValueError("the shares must add up to more than 0, and to a number; give one behaviour at least")
    return behaviours


class DataConfig(SettingsSection):
    num_episodes: Annotated[int, Field(ge=1, le=250_000)]
    """Simulator episodes to collect for the world model."""
    num_scattered: Annotated[int, Field(ge=0, le=100_000)]
    """Further ones of each task of the procedural scenes, whose object is put elsewhere before every step: only
    tokenizer and probes see them, and learn from them where things are."""
    num_heldout: Annotated[int, Field(ge=1, le=100_000)]
    """Episodes kept apart for the acceptance of the world model; never trained on."""
    behaviours: Annotated[dict[str, NonNegativeFloat], AfterValidator(_with_a_share)]
    """Relative share of each behaviour (expert, noisy, near_miss, biased, waypoint, random, reach, ...)."""
    num_workers: PositiveInt
    """Collecting processes."""
    start_frames: Literal["first", "any"]
    """Frames of real episodes that imagined ones begin at: first, after the reset; any: one of each episode at random,
    before its success."""
    policy_episodes: Annotated[int, Field(ge=0, le=10_000)]
    """Episodes of each weak cloned policy (policy_rl/pretraining.py) added to the world model's data; 0: none."""
    ground_truth: bool
    """False: wm train-model leaves the ground truth of recordings unread. Nothing is then supervised by positions, the
    policy sees none, and the model is judged by its pictures and done signal; success is the flag that was recorded."""


class TokenizerConfig(SettingsSection):
    kind: Literal["continuous", "lfq"]
    """continuous: real-valued latent tokens; lfq: lookup-free quantised tokens (MAGVIT-2)."""
    patch_px: PositiveInt
    """Side of the square patch behind one token, px; must divide the image."""
    latent_dim: PositiveInt
    """Values per token (continuous), or bits per token (lfq)."""
    width: PositiveInt
    """Channels of the encoder, and of the decoder, at one cell per token."""
    depth: PositiveInt
    """Residual blocks there, of the encoder and of the decoder."""
    num_iterations: PositiveInt
    """Gradient steps."""
    batch_size: PositiveInt
    """Frames per gradient step."""
    learning_rate: PositiveFloat
    """Of encoder, decoder and probe."""
    entropy_weight: NonNegativeFloat
    """Weight of the loss that makes every token sure of its code, and all codes used; lfq only."""
    commitment_weight: NonNegativeFloat
    """Weight of the loss that keeps the encoder's output near its code; lfq only."""
    foreground_weight: NonNegativeFloat
    """Extra weight of foreground pixels."""
    worst_weight: NonNegativeFloat = 0.0
    """Without ground truth: weight of the loss of each frame's worst pixels, against losing small things."""
    probe_weight: NonNegativeFloat = 0.1
    """Weight of the loss of the positions that a probe reads off the latents; without ground truth, of the action and
    the success that were recorded with the frame."""
    success_state: bool = False
    """Without ground truth: the state, and the state at which the episode succeeds, take the places of the positions
    that model and done heads learn to say."""
    probe_depth: PositiveInt = 1
    """Hidden layers of the probe."""
    probe_iterations: NonNegativeInt = 0
    """Iterations for which the probe trains on alone, once the tokenizer is trained."""
    decoder_iterations: NonNegativeInt = 0
    """Iterations for which a copy of the decoder trains on, for rollouts of the trained action model; 0: rollouts are
    shown by the tokenizer's own (not lfq)."""
    adversarial_weight: NonNegativeFloat = 0.0
    """Weight, in these iterations, of the loss against a discriminator of image patches."""
    foreground: Literal["background", "surroundings"] = "background"
    """Foreground are pixels that differ from the median frame, or, where tables and scenes change, from the mean of the
    pixels around them."""


class WorldModelConfig(SettingsSection):
    width: PositiveInt
    """Transformer width."""
    depth: PositiveInt
    """Transformer blocks."""
    num_heads: PositiveInt
    """Attention heads per block."""
    window: PositiveInt
    """Frames the temporal attention looks back over."""
    num_iterations: PositiveInt
    """Gradient steps of the action model."""
    batch_size: PositiveInt
    """Episodes, or parts of episodes, per gradient step."""
    learning_rate: PositiveFloat
    """Of the action model; the text model takes half of it."""
    condition_map: NonNegativeInt = 0
    """Hidden width of the MLP by which every token's input depends on the whole action and pose; 0: none (not lfq)."""
    rollout_steps: Annotated[list[PositiveInt], Field(min_length=1)]
    """Curriculum: imagined steps unrolled and back-propagated through, raised in equal stages over the training."""
    part_steps: NonNegativeInt = 0
    """Steps of the random parts of episodes that the action model is rolled out over in training; 0: whole episodes."""
    latent_weight: PositiveFloat = 1.0
    """Weight of the loss on the predicted latents, a mean over all tokens and values, whose gradient is small beside
    those of the other losses."""
    done_weight: NonNegativeFloat
    """Weight of the done loss (RS-4)."""
    num_done_heads: PositiveInt
    """Independent done heads; their minimum is the done signal, their spread the uncertainty."""
    decoding_steps: PositiveInt
    """MaskGIT passes per frame (lfq only)."""
    text_num_iterations: PositiveInt
    """Iterations of the text model, warm-started from the action model."""
    text_encoder: str = ""
    """Folder of a sentence encoder (MiniLM, T5) in the layout of transformers that reads the instructions, any words;
    empty: a learned embedding of the words of the training instructions."""
    state_weight: NonNegativeFloat
    """Weight of the auxiliary losses on simulator positions, of the predicted frame and of the model's own reading. 0:
    no positions at all, also not in the losses of decoded_weight."""
    decoded_weight: NonNegativeFloat
    """Weight of the losses on predicted frames after decoding, and after encoding them again (0: off)."""
    state_model_iterations: NonNegativeInt = 0
    """Gradient steps of a small model of states alone, which predicts them and the done signal, in float32 (RS-1g); RL
    of policies that see the state alone then imagines no pictures. 0: none. For states that say where everything is
    that success depends on, and tokenizer.kind continuous."""
    object_reader_iterations: NonNegativeInt = 0
    """Gradient steps of a reader of where things are, which makes that part of the state (simulation.object_state). 0:
    none. Of models that collect their own episodes, in tasks with SimulatorPart.object_state."""


class ImaginedEnvironmentConfig(SettingsSection):
    """How the world model shows itself to a policy that is trained in it."""

    picture_noise: NonNegativeFloat
    """Standard deviation of Gaussian noise on the latents of shown frames; the model goes on without it."""
    second_model: str
    """Folder of another world model with the same tokenizer, e.g. a refreshed one, that imagines the same actions: the
    lower done signal of both counts, and their difference as disagreement. Empty: none."""


class VideoEnvironmentConfig(SettingsSection):
    """How the video model makes a frame where it is the environment."""

    num_steps: PositiveInt
    """Sampler steps, each a call of the network."""
    shift: PositiveFloat
    """Of the flow times towards the noise; 1: none."""


class RewardConfig(SettingsSection):
    mode: Literal["delta", "abs", "progress"]
    """Dense reward (RS-5): change of the goal distance, its level, or progress along the golden trajectory, in rollouts
    that stay on the model's device."""
    dense_weight: NonNegativeFloat
    """Factor of the dense reward; 0: no goal is needed."""
    sparse_weight: NonNegativeFloat
    """Reward of the step on which the done signal crosses success_threshold."""
    success_threshold: Fraction
    """tau_s of RS-7: the done signal above which the sparse reward is paid and the episode terminates."""
    goal_threshold: Fraction
    """tau_goal of RS-6: the text model's done signal above which its frame is the goal."""
    dense_clip: PositiveFloat
    """Most dense reward of one step; what a step loses is not clipped, so that no cycle is paid."""
    uncertainty_limit: NonNegativeFloat
    """An imagined step above it pays no sparse reward and truncates the episode; 0: off."""
    factory: FactoryName = ""
    """module:callable(config) -> RewardModel (reward/base.py) instead of the built-in one; empty: none."""

    @property
    def needs_golden(self) -> bool:
        """Whether golden trajectories are compared with, not goals alone."""
        return self.mode == "progress" and self.dense_weight > 0


class PolicyConfig(SettingsSection):
    width: PositiveInt
    """Hidden width of the actor, and of the critic."""
    depth: PositiveInt
    """Hidden layers of the actor, and of the critic."""
    projection: PositiveInt
    """Width to which the encoder features are projected first; keeps the weights below the 1 MiB that travel inline."""
    init_log_std: float
    """Initial log standard deviation of the Gaussian, normalised action units."""
    inputs: PolicyInputs
    """What the policy sees of a picture, beside the state: the tokenizer's latents, projected; the positions that its
    probe reads off them, as they are, which are privileged where it learned them from a simulator; or both. state: the
    state alone, nothing of the picture."""
    dropout: Annotated[float, Field(ge=0, lt=1)]
    """Share of the projected latents that cloning hides from the actor in each gradient step."""
    two_valued_actions: tuple[str, ...] = ()
    """Names of actions that are executed as -1 or 1, by their sign, e.g. [gripper]: else a clone that is unsure between
    open and closed commands a half-open gripper."""
    ignored_state: tuple[str, ...] = ()
    """Names of state values that the policy does not see, where the state has them: from few demonstrations it would
    learn to follow what does not matter."""
    position_center_m: tuple[float, float, float] = (0.6, 0.0, 0.15)
    """Commanded positions (x, y, z) are shifted by it before the networks see them."""
    position_scale_m: PositiveFloat = 0.2
    """Commanded positions lie within about this of the centre, by which they are divided."""
    rotation_scale_rad: PositiveFloat = 0.5
    """Commanded angles are divided by it."""
    factory: FactoryName = ""
    """module:callable(config) -> ImagePolicy instead of the one that sees by the tokenizer; empty: none."""
    checkpoint: str = ""
    """Folder of an OpenVLA checkpoint, as published, to be the policy instead (policy_rl/openvla); empty: none."""

    @property
    def foreign(self) -> bool:
        """Whether it sees by something else than the world model's tokenizer."""
        return bool(self.factory or self.checkpoint)


class LearnerConfig(SettingsSection):
    factory: FactoryName = ""
    """module:callable(policy, config) -> Learner (policy_rl/learner.py) instead of PPO; empty: none."""


class SftConfig(SettingsSection):
    num_demonstrations: PositiveInt
    """Up to 750, with a third more in reserve, no two root seeds share a reset seed."""
    num_iterations: PositiveInt
    """Gradient steps."""
    batch_size: PositiveInt
    """Transitions per gradient step."""
    learning_rate: PositiveFloat
    """Of the actor."""
    weight_decay: NonNegativeFloat
    """Of AdamW."""
    heldout: Fraction
    """Share of the demonstrations, and of the recoveries, that are not learned: the weights with the least error on
    them are kept. 0: those of the last gradient step."""
    bags: list[str] = Field(default=[])
    """Recordings whose successful episodes are the demonstrations, whoever acted; empty: MPLib plans them."""
    scenes: ScenesName = ""
    """Where MPLib plans them, as simulation.scenes; empty: there."""
    recoveries: NonNegativeInt = 0
    """Further demonstrations, which the task's script acts from where a clone of the others has got to after some of
    its steps; only the script's are learned."""
    state_noise_m: NonNegativeFloat = 0.0
    """Above 0, where a reader fills simulation.object_state: demonstrations say the truth there and are learned once
    more as it is read, both off by noise of this standard deviation, drawn anew for every gradient step."""


class PpoConfig(SettingsSection):
    updates: NonNegativeInt
    """Updates of the training, each on a rollout of num_steps lock-steps."""
    num_envs: PositiveInt
    """Environments that step together."""
    num_steps: PositiveInt
    """Lock-steps per update."""
    advantage: Literal["gae", "group"]
    """gae: PPO, with a critic; group: GRPO, of each environment's first episode against those from the same start."""
    group_size: Annotated[int, Field(ge=2)]
    """group: environments that begin at the same start; must divide num_envs."""
    advantage_floor: NonNegativeFloat = 0.0
    """Least standard deviation that gae's advantages are divided by. Without rewards they are the critic's errors
    alone; divided by their own spread, these move the policy as much as rewards would."""
    group_std: bool
    """group: divide by the standard deviation of the group's returns; false: Dr. GRPO."""
    leave_one_out: bool
    """group: compare an episode with the mean of the others only."""
    gamma: Fraction
    """Discount of the reward one step later."""
    gae_lambda: Fraction
    """gae: 0 gives one-step TD errors, 1 sums to the end of the episode."""
    clip: PositiveFloat
    """The ratio of an action's new to its old probability counts down to 1 - clip and up to 1 + clip."""
    value_clip: NonNegativeFloat
    """0: the value loss is not clipped."""
    epochs: PositiveInt
    """Passes over a rollout per update."""
    minibatch_size: PositiveInt
    """About so many transitions per gradient step."""
    learning_rate: PositiveFloat
    """Of the actor."""
    value_learning_rate: PositiveFloat
    """Of the critic."""
    value_weight: NonNegativeFloat
    """Weight of the value loss."""
    entropy_weight: NonNegativeFloat
    """Weight of the bonus for the policy's entropy."""
    kl_reference_weight: NonNegativeFloat
    """Weight of KL(policy || SFT policy), against exploiting the model."""
    max_grad_norm: PositiveFloat
    """Gradients of a larger norm are scaled down to it."""
    target_kl: NonNegativeFloat
    """An update ends before the first minibatch whose approximate KL to the policy that acted is above it, nats; 0:
    never."""
    min_log_std: float = -20.0
    """Floor of the policy's log standard deviation, normalised action units: a policy that stops exploring has ratios
    without bound."""
    converged_updates: NonNegativeInt = 0
    """Training ends as converged after so many updates in a row in whose rollouts no episode failed; 0: never."""
    value_warmup_updates: NonNegativeInt
    """gae: first updates that train the critic only."""

    @model_validator(mode="after")
    def _check_groups(self) -> Self:
        if self.num_envs % self.envs_per_start:
            raise ValueError(f"num_envs {self.num_envs} must be a multiple of group_size {self.group_size}")
        return self

    @property
    def envs_per_start(self) -> int:
        """Environments that are reset with one seed."""
        return self.group_size if self.advantage == "group" else 1


class RunConfig(SettingsSection):
    seed: NonNegativeInt
    """Root of all random numbers."""
    task: TaskName
    """Name of the task; empty: none."""
    device: DeviceName
    """Of every model, reward and learner. Processes that collect in the simulator compute on the CPU."""
    environment: EnvironmentConfig
    """The real environment."""
    simulation: SimulationConfig
    """The simulator's scenes, cameras, actions and limits, of `task`."""
    gymnasium: GymnasiumConfig
    """A Gymnasium environment."""
    data: DataConfig
    """Episodes that are collected for the world model."""
    tokenizer: TokenizerConfig
    """Observations to latent tokens and back."""
    world_model: WorldModelConfig
    """The action model and the text model, over latent tokens."""
    imagined_environment: ImaginedEnvironmentConfig
    """The world model as an environment."""
    video_environment: VideoEnvironmentConfig
    """The video model as an environment."""
    reward: RewardConfig
    """What imagined steps are worth."""
    judge: JudgeConfig
    """The reward agent."""
    policy: PolicyConfig
    """The actor and the critic."""
    learner: LearnerConfig
    """What trains the policy."""
    sft: SftConfig
    """Behaviour cloning of the weak policy that RL begins with."""
    ppo: PpoConfig
    """RL of the policy."""
    exploit_meter: ExploitMeterConfig
    """How often the simulator is asked about imagined success."""
    acceptance: AcceptanceConfig
    """What a world model must show before it is trained in."""
    model_refresh: ModelRefreshConfig
    """Rounds of training and of refreshing the model."""
    evaluation: EvaluationConfig
    """How the policy is measured."""

    @model_validator(mode="after")
    def _check_scenes(self) -> Self:
        if self.task:
            instruction(self.task, self.simulation.scenes)
            if self.sft.scenes:
                instruction(self.task, self.sft.scenes, "sft.scenes")
        return self
