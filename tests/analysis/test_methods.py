"""One name for each method: what tables print, arguments accept."""

from __future__ import annotations

from typing import Any

import pytest

from offbench.analysis.methods import Method, find_method, method_order, name_methods, unnamed_settings
from offbench.common.errors import OffbenchError
from offbench.training.run_config import RunConfig


def named(*methods: tuple[str, str, object], labels: tuple[str, ...] = ()) -> list[Method]:
    """Return the methods of (algorithm, variant, beta)."""
    texts = [*labels, *[""] * len(methods)]
    common: dict[str, Any] = {"dataset": "x-v0", "dataset_sha256": "", "seed": 0, "steps": 1, "references": {}}
    configs = {
        (algorithm, variant): [
            RunConfig(algorithm=algorithm, variant=variant, settings={"beta": beta}, label=label, **common)
        ]
        for (algorithm, variant, beta), label in zip(methods, texts, strict=False)
    }
    return list(name_methods(configs).values())


def test_names_have_what_tells_variants_apart() -> None:
    methods = named(
        ("td3_bc", "default", None),
        ("cql", "bc_steps=120,eval_samples=10", None),
        ("bdb", "hidden=8x8,beta=0.25", 0.25),
        ("bdb", "hidden=8x8", "adaptive"),
    )
    assert [method.label for method in methods] == ["td3_bc", "cql", "bdb (beta=0.25)", "bdb (adaptive)"]
    assert unnamed_settings(methods) == [
        "cql: bc_steps=120, eval_samples=10",
        "bdb (beta=0.25): hidden=8x8",
        "bdb (adaptive): hidden=8x8",
    ]
    methods = named(("bdb", "hidden=8x8", "adaptive"), ("bdb", "default", "adaptive"))
    assert [method.label for method in methods] == ["bdb (adaptive, hidden=8x8)", "bdb (adaptive)"]
    assert unnamed_settings(methods) == []
    # a setting that makes another method of it stays, even where nothing else is there
    (method,) = named(("bdb", "beta_max=0.5", "adaptive"))
    assert method.label == "bdb (adaptive, beta_max=0.5)"


def test_a_label_is_the_name_unless_two_methods_have_it() -> None:
    one, other = named(("cql", "bc_steps=1", None), ("td3_bc", "default", None), labels=("short CQL",))
    assert (one.label, other.label) == ("short CQL", "td3_bc")
    assert unnamed_settings([one, other]) == ["short CQL: bc_steps=1"]
    assert find_method([one, other], "short CQL") == one
    one, other = named(("cql", "bc_steps=1", None), ("td3_bc", "default", None), labels=("td3_bc",))
    assert (one.label, other.label) == ("cql (bc_steps=1)", "td3_bc")


def test_a_label_that_is_the_name_of_another_method() -> None:
    variants = (("bc", "hidden=8x8", None), ("bc", "hidden=8x9", None), ("bc", "hidden=8x10", None))
    assert len({method.label for method in named(*variants, labels=("x", "x", "bc (hidden=8x8)"))}) == 3


def test_a_beta_that_rounds_to_the_papers_is_not_the_papers() -> None:
    published = [method.published for method in named(("bdb", "beta=0.25", 0.25), ("bdb", "beta=0.2512", 0.2512))]
    assert published == ["bdb beta=0.25", "bdb beta=0.2512"]


def test_variants_with_one_label_on_other_datasets_are_one_method() -> None:
    common: dict[str, Any] = {"algorithm": "rebrac", "dataset_sha256": "", "seed": 0, "steps": 1, "references": {}}

    def methods(*datasets: tuple[str, ...]) -> list[Method]:
        return list(
            name_methods(
                {
                    ("rebrac", variant): [
                        RunConfig(variant=variant, settings={}, label="rebrac", dataset=name, **common)
                        for name in names
                    ]
                    for variant, *names in datasets
                }
            ).values()
        )

    one, other = methods(("default", "a-v0", "b-v0"), ("actor_penalty=0.1", "c-v0"))
    assert one == other
    assert one.label == "rebrac"
    assert unnamed_settings([one]) == ["rebrac: different for each dataset"]
    assert find_method([one], "rebrac") == one
    one, other = methods(("default", "a-v0", "b-v0"), ("actor_penalty=0.1", "b-v0"))
    assert (one.label, other.label) == ("rebrac", "rebrac (actor_penalty=0.1)")


def test_every_spelling_is_found() -> None:
    methods = named(("td3_bc", "default", None), ("bdb", "beta=0.5", 0.5), ("bdb", "default", "adaptive"))
    spellings = [
        ["td3_bc", "td3_bc/default", "td3_bc (30,000 steps)", "td3_bc (10 of 30,000 steps)"],
        ["bdb/beta=0.5", "bdb (beta=0.5)", "bdb 0.5", "bdb/0.5", "bdb (beta=0.5) (30,000 steps)"],
        ["bdb", "bdb/default", "bdb (adaptive)", "bdb adaptive", "bdb/adaptive", "bdb (adaptive) (30,000 steps)"],
    ]
    for method, names in zip(methods, spellings, strict=True):
        for name in names:
            assert find_method(methods, name) == method
    assert find_method(methods, "bdb").variant == "default"
    with pytest.raises(OffbenchError, match=r"no method 'bdb/beta=0.51' here: did you mean 'bdb \(beta=0.5\)'"):
        find_method(methods, "bdb/beta=0.51")


def test_the_variants_of_a_sweep_are_ordered_by_their_numbers() -> None:
    order = [
        *(("td3_bc", v, None) for v in ("default", "alpha=0.5", "alpha=1", "alpha=2.5", "alpha=10", "alpha=1e3")),
        *(("bdb", f"beta={beta}", beta) for beta in (0.25, 0.5)),
        ("bdb", "default", "adaptive"),
        *(("bdb", f"hidden={hidden}", "adaptive") for hidden in ("64x64", "64x256", "256")),
    ]
    methods = named(*order[::-1])
    assert [method.variant for method in sorted(methods, key=method_order)] == [variant for _, variant, _ in order]


def test_names_as_tables_print_them_are_found() -> None:
    variants = (("bc", "hidden=8x8", None), ("bc", "hidden=9x9", None), ("td3_bc", "default", None))
    methods = named(*variants, labels=("short (1,000 steps)", "my  bc"))
    for name in (
        "short (1,000 steps)",
        "my  bc",
        "my bc",
        "my bc (steps differ)",
        "td3_bc (300,000 of 1,000,000 steps)",
    ):
        assert find_method(methods, name).label.split()[0] == name.split()[0]
