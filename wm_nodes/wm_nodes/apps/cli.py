"""The command `wm VERB ...`: the table of verbs, and one style of errors and exit codes for all of them.

The module of a verb has `add_options(parser)` and `run(arguments)`, which returns an exit code, or None for 0; its
docstring is the text of `wm VERB --help`. Only the chosen module is imported, and for --help none (see apps/help).
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import io
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NoReturn

from wm_nodes.apps.help import asked_page
from wm_nodes.core.errors import ModelNotAcceptedError, RunError
from wm_nodes.core.interrupts import leaving_when_interrupted

DONE, DIFFERENT, ERROR, NOT_ACCEPTED, INTERRUPTED = 0, 1, 2, 3, 130
EXIT_CODES = (
    "exit codes: 0 done; 1 checked, and something failed or differs; 2 an error, in one line;\n"
    "3 the world model does not pass acceptance; 130 interrupted"
)
EXPECTED = (RunError, ValueError, OSError, ImportError, FloatingPointError)
"""Errors whose text says what to do; anything else is a fault of this program and shows its traceback."""
TOP = ("--seed", "--task", "--device")
"""Settings that are options of a verb, or cannot be given."""
EXPERIMENT_WORDS = ("benchmark", "reproduce")
"""First words of verbs that are experiments."""
BENCHMARKS = "benchmarks"
"""Package beside this one in the repository, not installed with it."""
NO_BENCHMARKS = "the benchmarks come with the repository and are not installed; start launch_scripts/wm.py there"


GROUPS = {
    "train": {
        "train-model": "a world model on recordings of your own, judged on some of them",
        "train-policy": "a policy in the world model, measured in the simulator",
        "train-video-model": "the video world model by GRPO on its own clips",
        "check-video-model": "whether a video model is fit to be trained so",
    },
    "recordings": {
        "collect": "episodes of tasks in the simulator, planned and scripted",
        "view": "a recording, or a run, on a live page of this host",
        "rescore": "score a recording again, compare bit for bit",
        "follow-clips": "a video model's clips as episodes that a policy is cloned from",
        "retrain": "train a video model again on a run's recorded clips and scores",
        "recover-bag": "bring back a recording whose process was killed",
        "import rosbag": "plain ROS bags of your robot into one of ours, by a contract",
    },
    "judge": {
        "judge serve-help": "which open model for which memory, and how it is served",
        "judge check": "what a judge is good for, by shipped labelled clips",
        "judge-clips": "judge videos of your own",
        "judge calibrate": "the embedded judge, on recordings in which nothing is wrong",
        "judge hack": "whether a judge can be hacked on clips of your own",
        "audit": "verify, label, replay and compare the judge's logs",
    },
    "benchmarks, where the repository is": {
        "benchmark speed": "graph, world model and simulator, side by side",
        "benchmark device-speed": "what a GPU makes of both loops",
        "benchmark view": "CPU time that the live page costs the other nodes",
        "benchmark trained-in": "policies trained in each model, measured in the simulator",
        "benchmark ranking": "imagined success of policies against their real success",
        "benchmark policy": "success of a policy in an environment of your own, and what that measures beside it",
        "reproduce roboscape": "Tables 1 and 2, Figures 2, 3, 4 and 9 of RoboScape-R at this size, with every control",
        "benchmark clones": "success of cloned policies by what they see and by the number of demonstrations",
        "benchmark replays": "how many of a policy's imagined successes are real, in scenes of every split",
        "benchmark disc-base": "the video model that experiments on the moving disc begin with",
        "benchmark diversity": "diversity on the moving disc, at equal quality and noise budget",
        "benchmark learning": "reward against model calls, every sampler on one learner",
        "benchmark ablations": "KL, advantage clip, guidance, resolution, in pairs",
        "benchmark hacking": "a reward that can be hacked, and what detects it",
        "benchmark cost": "seconds and bytes of the KL anchors, and of the mask",
        "benchmark clips": "diversity on a video model of recorded episodes",
        "benchmark clip-learning": "learning on a video model of recorded episodes",
        "benchmark resolution": "a video model on larger pictures than it was trained on",
        "benchmark outcome": "a video model that chooses the motion, by its outcome",
        "benchmark as-written": "the same by the settings of the paper, DynDiff beside other samplers",
        "benchmark closed-loop": "a video model that goes on from its own frames, with controls",
        "benchmark public-size": "memory and time of public video models of their real sizes",
        "benchmark openvla-size": "memory and arithmetic of OpenVLA-7B as a policy",
        "benchmark erring": "the reward agent under a judge that errs",
        "benchmark success-clips": "any judge on other people's labelled episodes",
        "benchmark tables": "the full tables of the result pages, from the result files",
    },
}
VERBS = {name: about for verbs in GROUPS.values() for name, about in verbs.items()}
"""What each verb does, by its name; `train-policy` is the module wm_nodes.apps.train_policy, `judge check` is
wm_nodes.apps.judge.check, `benchmark NAME` and `reproduce NAME` experiments of benchmarks.experiment."""


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line, and whose `settings` are the settings that were given by name."""

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """Raises ConfigError for a setting without a value, and SystemExit as parse_args."""
        from wm_nodes.config.load import SCHEMAS, split_settings

        options = self._option_string_actions
        schema = SCHEMAS.get(self.get_default("settings_of"))
        names = [name for name in (schema.model_fields if schema else ()) if f"--{name}" not in {*options, *TOP}]
        rest, settings = split_settings(words, names)
        arguments, left = self.parse_known_args(rest)
        taken = getattr(arguments, "settings_of", None)
        left += [f"--{name}" for name in settings if not taken or (taken not in SCHEMAS and not name.startswith(taken))]
        if left:
            close = difflib.get_close_matches(left[0], [*options, *(f"--{name}" for name in names)], n=1)
            self.error(f"unrecognized arguments: {' '.join(left)}{f'; did you mean {close[0]}?' if close else ''}")
        arguments.settings = settings
        return arguments

    def error(self, message: str) -> NoReturn:
        self.exit(ERROR, f"error: {message}; see {self.prog} --help\n")


def main(argv: Sequence[str] | None = None, program: str = "wm") -> int:
    """Run the verb that the arguments begin with and return the exit code. program: how this command was started.

    Raises:
        SystemExit: after --help, and where a verb has no such option.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    for count in (1, 2):
        if (name := " ".join(words[:count])) in VERBS:
            return run_verb(name, words[count:], f"{program} {name}")
    begun = [verb for verb in VERBS if words and verb.startswith(f"{words[0]} ")]
    if (words[1:] if begun else words)[:1] in ([], ["-h"], ["--help"]):
        print(overview(program, begun))
        return DONE
    typed = " ".join(words[: 2 if begun else 1])
    close = difflib.get_close_matches(typed, VERBS, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return _fail(f"unknown verb {typed!r}; {hint}{program} --help lists the verbs")


def run_verb(name: str, argv: Sequence[str], program: str) -> int:
    """Run one verb and return its exit code. program: the words before the options, as they were typed.

    Raises:
        SystemExit: after --help, and where the verb has no such option.
    """
    arguments = argparse.Namespace()
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")  # a terminal may lack a character; no reason to end
        if (page := asked_page(name, argv, program)) is not None:
            print(page, end="")
            raise SystemExit(DONE)
        if not sys.stderr.isatty():
            os.environ.setdefault("TQDM_DISABLE", "1")  # bars of libraries; ours are lines then
        arguments = parser_of(name, program).parse(argv)
        arguments.command = shlex.join([*program.split(), *argv])
        run: Callable[[argparse.Namespace], int | None] = arguments.run
        return run(arguments) or DONE
    except ModelNotAcceptedError as refusal:
        return _fail(str(refusal), NOT_ACCEPTED)
    except ModuleNotFoundError as error:
        return _fail(NO_BENCHMARKS if error.name == BENCHMARKS else str(error))
    except EXPECTED as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        resume = "; name the run folder with --run-dir to go on" if "run_dir" in arguments else ""
        print(f"interrupted{resume}", file=sys.stderr)
        return INTERRUPTED


def parser_of(name: str, program: str) -> Parser:
    """The parser of a verb, which imports its module. Its arguments' `run` does the verb."""
    group, _, experiment = name.partition(" ")
    with leaving_when_interrupted():
        verb: Any = (
            import_module(f"{BENCHMARKS}.experiment").find_experiment(experiment) if group in EXPERIMENT_WORDS
            else import_module(module_of(name))
        )
    parser = Parser(
        prog=program, description=inspect.cleandoc(verb.__doc__), epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=verb.start if group in EXPERIMENT_WORDS else getattr(verb, "run", None))
    verb.add_options(parser)
    return parser


def module_of(verb: str) -> str:
    """The module of a verb; of `import rosbag` import_rosbag, as no package can be called import."""
    return f"wm_nodes.apps.{verb.replace('import ', 'import_').replace('-', '_').replace(' ', '.')}"


def refuse_module(name: str) -> NoReturn:
    """End the process, as `python -m` with the module of a verb would do nothing."""
    typed = next((f"wm {verb}" for verb in VERBS if module_of(verb) == name), "wm --help")
    raise SystemExit(_fail(f"{name} is not started by itself; type: {typed}"))


def overview(program: str, names: Sequence[str] = ()) -> str:
    """The verbs in groups, a line each. names: only these; none: all."""
    lines = [f"usage: {program} VERB [options]; {program} VERB --help explains one"]
    width = max(map(len, VERBS))
    for title, verbs in GROUPS.items():
        if shown := [name for name in verbs if not names or name in names]:
            lines += ["", f"{title}:", *(f"  {name:{width}}  {verbs[name]}" for name in shown)]
    return "\n".join([*lines, "", EXIT_CODES])


def _fail(text: str, code: int = ERROR) -> int:
    print("error:", " ".join(text.splitlines()), file=sys.stderr)
    return code


if __name__ == "__main__":
    raise SystemExit(main(program="python -m wm_nodes.apps.cli"))
