"""The names of variants and their folders."""

from __future__ import annotations

from dataclasses import dataclass

from offbench.common.settings import setting
from offbench.training.spec import variant_name


def test_variants_keep_every_digit_and_letter() -> None:
    @dataclass(frozen=True)
    class Config:
        rate: float = setting(1.0, "")
        mode: str = setting("a", "")

    names = [
        variant_name(Config(rate, mode))
        for rate in (0.00012345678, 0.00012345679)
        for mode in ("B", "b", "x/y", "x,y")
    ]
    assert len({name.lower() if "mode=b" not in name.lower() else name for name in names}) == 8
    assert not any("/" in name for name in names)
    assert variant_name(Config(0.0003)) == "rate=0.0003"  # as ever


def test_a_setting_of_texts_is_one_folder_name() -> None:
    @dataclass(frozen=True)
    class Config:
        parts: tuple[str, ...] = setting((), "")

    names = [variant_name(Config(parts)) for parts in (("a", "b"), ("axb",), ("a/../../b",), ("a,b",))]
    assert names == ["parts=axb", "parts=a%78b", "parts=a%2F..%2F..%2Fb", "parts=a%2Cb"]
