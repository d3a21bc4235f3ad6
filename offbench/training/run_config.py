"""A run's config.json: RunConfig, and a Session for each platform that trained the run."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.provenance import Hardware
from offbench.common.scores import MAX_VALUE, are_references

FORMAT = "offbench-run-1"


@dataclass(frozen=True, kw_only=True)
class Session:
    """The platform that trained a run from `step` on, on which its results depend besides settings and seed.

    Attributes:
        device, precision, versions, hardware: as in offbench.common.provenance.training_platform.
    """

    step: int = 0
    device: str = ""
    precision: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    hardware: Hardware = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run's config.json: all that is needed to repeat the run, and to score it without its dataset.

    Attributes:
        dataset_sha256: the content hash of the dataset.
        references: (random, expert) returns by name: `dataset`, its own, and `d4rl`, D4RL's constants.
        env_spec: the environment it is evaluated in, as EnvSpec JSON; None if the dataset names none.
        env_code: hashes of that environment's code and files, if it is not Gymnasium's; empty in earlier versions.
        device, precision, versions, hardware: the platform of the first session.
        code: hashes of the algorithm's files (offbench.training.source_code); empty in runs of earlier versions.
        sessions: the later sessions that were trained with something else.
        label: the method's name in tables, if a grid gives one.
    """

    format: str = FORMAT
    algorithm: str
    variant: str
    settings: JsonObject
    dataset: str
    dataset_sha256: str
    seed: int
    steps: int
    eval_every: int = 0
    eval_episodes: int = 0
    references: dict[str, tuple[float, float] | None]
    env_id: str = ""
    env_spec: str | None = None
    env_code: dict[str, str] = field(default_factory=dict)
    command: str = ""
    device: str = ""
    precision: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    hardware: Hardware = field(default_factory=dict)
    code: dict[str, str] = field(default_factory=dict)
    sessions: tuple[Session, ...] = ()
    label: str = ""

    def __post_init__(self) -> None:
        """Raise OffbenchError for values that no run has."""
        if self.format != FORMAT:
            raise OffbenchError(f"format is {self.format[:40]!r}, not {FORMAT}: another version of offbench wrote it")
        for name in ("algorithm", "variant", "dataset", "label"):
            if len(getattr(self, name).splitlines()) > 1:
                raise OffbenchError(f"{name} has several lines, which would be rows of their own in tables")
        if self.seed < 0 or not 0 <= self.steps < MAX_VALUE:
            raise OffbenchError(f"seed {self.seed} or steps {self.steps} is out of range")
        if self.env_spec is not None:
            try:
                is_spec = isinstance(json.loads(self.env_spec), dict)
            except (ValueError, RecursionError):
                is_spec = False
            if not is_spec:
                raise OffbenchError(f"env_spec is not an EnvSpec but {self.env_spec:.60}")
        for name, pair in self.references.items():
            if name not in ("dataset", "d4rl"):
                raise OffbenchError(f"unknown references {name!r}")
            if pair and not are_references(*pair):
                raise OffbenchError(f"the references ({name}) are {pair[0]} and {pair[1]}")

    @property
    def history(self) -> list[Session]:
        """All sessions, the first one included."""
        first = Session(device=self.device, precision=self.precision, versions=self.versions, hardware=self.hardware)
        return [first, *self.sessions]
