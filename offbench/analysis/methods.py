"""Methods: an algorithm with its settings, and the one name that tables, figures and the command line have for it."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from offbench.common.errors import OffbenchError, nearest, unknown
from offbench.common.text import without_steps
from offbench.training.former_settings import FORMER_SETTINGS
from offbench.training.registry import algorithm_names
from offbench.training.run_config import RunConfig
from offbench.training.spec import folder_name

METHOD_ORDER = ("td3_bc", "cql", "bdb")  # column order of the BDB paper's Table 1
BY_DATASET = "different for each dataset"  # variant of a method whose settings differ between datasets
EXTENSION_SETTINGS = FORMER_SETTINGS["bdb"].keys()  # settings of bdb that are not in the paper


@dataclass(frozen=True)
class Method:
    """An algorithm with its settings.

    Attributes:
        beta: the value of a setting of that name, as in the columns of the published tables.
        name: a name given to it (a grid's `label`), or one without the settings that all variants here share.
    """

    algorithm: str
    variant: str
    beta: str | None = None
    name: str = ""

    @property
    def label(self) -> str:
        """The name in tables, figures and on the command line: `td3_bc`, `bdb (adaptive)`, `bdb (beta=0.25)`."""
        return self.name or self.named()

    @property
    def settings(self) -> list[str]:
        """Beta, then the settings that differ from their defaults: `["adaptive", "hidden=8x8"]`."""
        parts = [] if self.variant == "default" else self.variant.split(",")
        beta = [part for part in parts if part.startswith("beta=")]
        rest = [part for part in parts if not part.startswith("beta=")]
        if not beta and self.beta is not None:
            beta = [f"beta={self.beta}"]
        values = (part.partition("=")[2] for part in beta)
        return [value if value.isalpha() else f"beta={value}" for value in values] + rest

    def named(self, without: Collection[str] = ()) -> str:
        """Return algorithm and settings as one name, some settings left out."""
        parts = [part for part in self.settings if part not in without]
        return f"{self.algorithm} ({', '.join(parts)})" if parts else self.algorithm

    @property
    def spellings(self) -> set[str]:
        """Every way to write this method as an argument."""
        beta = [] if self.beta is None or "beta=" in self.variant else [f"beta={self.beta}"]
        whole = ",".join([*beta, *([] if self.variant == "default" else [self.variant])])
        variants = {self.variant, folder_name(self.variant), whole, whole.removeprefix("beta=")} - {""}
        names = {f"{self.algorithm}{by}{variant}" for variant in variants for by in ("/", " ")}
        return names | {self.label, self.named()}

    @property
    def published(self) -> str:
        """The method's name in published/scores.csv; empty for what no paper has."""
        if {part.partition("=")[0] for part in self.variant.split(",")} & EXTENSION_SETTINGS:
            return ""
        return self.algorithm if self.beta is None else f"{self.algorithm} beta={self.beta}"


def method_of(algorithm: str, variant: str, settings: Mapping[str, object]) -> Method:
    """Return a method, named without regard to other methods."""
    return Method(algorithm, variant, _beta(settings.get("beta")))


def name_methods(configs: Mapping[tuple[str, str], Sequence[RunConfig]]) -> dict[tuple[str, str], Method]:
    """Return the method of each (algorithm, variant), named so that no two have the same name.

    A name is the label that all its runs have (`label` of a grid's entry), or the algorithm with beta and the settings
    that tell its variants apart here: what they share is left out, except settings that make another method of it.
    Variants of an algorithm with one label are one method, unless two of them are on the same dataset.

    Args:
        configs: the config.json of every run of each method.
    """
    plain = {key: method_of(*key, runs[0].settings) for key, runs in configs.items()}
    labels = {key: _label(runs) for key, runs in configs.items()}
    for algorithm, label in {(key[0], label) for key, label in labels.items() if label}:
        alike = [key for key in configs if key[0] == algorithm and labels[key] == label]
        datasets = [{config.dataset for config in configs[key]} for key in alike]
        if len(alike) > 1 and len(set.union(*datasets)) == sum(map(len, datasets)):
            plain |= dict.fromkeys(alike, Method(algorithm, BY_DATASET))
    names = {}
    for key, method in plain.items():
        siblings = [set(other.settings) for other in plain.values() if other.algorithm == method.algorithm]
        shared = {part for part in set.intersection(*siblings) if "=" in part}
        shared = {part for part in shared if part.partition("=")[0] not in {*EXTENSION_SETTINGS, "beta"}}
        names[key] = labels[key] or method.named(shared)
    for longer in (Method.named, lambda method: f"{method.algorithm}/{method.variant}"):
        taken = Counter(name for name, _ in {(names[key], method) for key, method in plain.items()})
        names = {key: names[key] if taken[names[key]] == 1 else longer(method) for key, method in plain.items()}
    return {key: dataclasses.replace(method, name=names[key]) for key, method in plain.items()}


def _label(runs: Sequence[RunConfig]) -> str:
    """Return the label that all runs have, else an empty one."""
    labels = {config.label for config in runs}
    return labels.pop() if len(labels) == 1 else ""


def unnamed_settings(methods: Iterable[Method]) -> list[str]:
    """Return a note for each method with settings that its name leaves out: `cql: bc_steps=120`."""
    notes = []
    for method in methods:
        shown = method.settings if method.label == method.named() else re.split(r"[(), ]+", method.label)
        if left_out := [part for part in method.settings if part not in shown]:
            notes.append(f"{method.label}: {', '.join(left_out)}")
    return notes


def find_method(methods: Sequence[Method], name: str) -> Method:
    """Return the method of a name: as in a table, ALGO/VARIANT, or ALGO for its default or only variant.

    Raises:
        OffbenchError: no such method here, or the algorithm has several variants.
    """
    one_line = " ".join(str(name).split())
    by_label = {" ".join(method.label.split()): method for method in methods}
    name = without_steps(one_line)
    for label in (one_line, name):
        if label in by_label:
            return by_label[label]
    matches = [method for method in methods if name in method.spellings]
    if len(matches) == 1:
        return matches[0]
    algorithm = re.split(r"[/ ]", name)[0]
    variants = [method for method in methods if method.algorithm == algorithm]
    labels = ", ".join(f"'{method.label}'" for method in variants or methods)
    if not variants:
        if algorithm in algorithm_names():
            raise OffbenchError(f"{algorithm} has no evaluated runs here; available: {labels}")
        raise unknown("method", name, [method.label for method in methods])
    if name == algorithm:
        default = variants if len(variants) == 1 else [method for method in variants if method.variant == "default"]
        if len(default) == 1:
            return default[0]
        raise OffbenchError(f"{algorithm} has several variants: give one of {labels}")
    near = nearest(name, [method.label for method in variants])
    hint = f"did you mean '{near}'?" if near else f"there are {labels}"
    raise OffbenchError(f"no method {name!r} here: {hint}")


def _beta(value: object) -> str | None:
    if isinstance(value, int | float) and abs(value) < 1e6:
        return text if float(text := f"{value:.2f}") == value else f"{value:g}"
    # settings of a damaged config.json or a third party's algorithm
    return None if value is None else f"{' '.join(str(value).split()):.60}"


def rank(name: str, order: Sequence[str]) -> tuple[int, str]:
    """Return a sort key: the position of a name in `order`; names not in `order` come last, sorted."""
    return (order.index(name) if name in order else len(order), name)


def method_order(method: Method) -> tuple[object, ...]:
    """Return the sort key for the order of the paper's table: numeric betas in order, then names (adaptive)."""
    is_default = method.variant == "default"
    return rank(method.algorithm, METHOD_ORDER), _natural(method.beta or ""), not is_default, _natural(method.variant)


def _natural(text: str) -> tuple[list[str | float], str]:
    """Return a sort key that puts `hidden=64` before `hidden=256`."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", text)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)], text
