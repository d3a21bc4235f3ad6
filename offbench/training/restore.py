"""`restore`: a run's learning state from its newest checkpoint."""

from __future__ import annotations

from offbench.common import checkpoints
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.common.settings import build
from offbench.data import transitions
from offbench.training.former_settings import current_settings
from offbench.training.registry import algorithm_names, load_algorithm, register
from offbench.training.run import Run
from offbench.training.source_code import code_of
from offbench.training.spec import RunSpec, settings_json
from offbench.training.stack import Stack, check_origin


def restore(run: Run, algorithm: str | type | None = None) -> Stack:
    """Return a run's learning state from its newest checkpoint, on the CPU.

    Args:
        algorithm: the run's algorithm, if no installed package has it: `./my_algo.py:ReBRAC`, or the class.

    Raises:
        OffbenchError: no run, no checkpoint, its dataset is gone or changed, or its algorithm is another or unknown.
    """
    config = run.config()
    if algorithm is not None and register(algorithm) != config.algorithm:
        raise OffbenchError(f"{run.folder} is a run of {config.algorithm}, not of {register(algorithm)}")
    try:
        algorithm_class = load_algorithm(config.algorithm)
    except OffbenchError as error:
        if config.algorithm in algorithm_names():
            raise
        raise OffbenchError(f"{error}; for a file of your own, give --algorithm ./FILE.py:CLASS") from None
    recorded = current_settings(config.algorithm, config.settings, str(run.folder))
    if changed := describe_changes(config.code, code_of(config.algorithm)):
        raise OffbenchError(
            f"{run.folder} was trained by other code of {config.algorithm}: {changed}; restore that code, or train the"
            " run again"
        )
    settings = build(algorithm_class.Config, recorded, f"{run.config_path}: settings")
    data = transitions.load(config.dataset)
    if data.content_sha256 != config.dataset_sha256:
        raise OffbenchError(f"{data.dataset_id} is no longer the dataset that {run.folder} was trained on")
    newest = checkpoints.load_newest(run.folder)
    if newest is None:
        raise OffbenchError(f"{run.folder} has no checkpoint yet; train it until the first one is written")
    tensors, state = newest
    schedule = config.steps, config.eval_every, config.eval_episodes
    check_origin(run.folder, state, settings_json(settings))  # before networks of that size are made
    spec = RunSpec(config.algorithm, settings, config.dataset, config.seed, *schedule, run.folder)
    stack = Stack(algorithm_class, [spec], {config.dataset: data}, "cpu")
    stack.load(0, tensors, state)
    stack.step = int(state["step"])
    return stack
