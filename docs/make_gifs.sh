#!/bin/sh
# Create the animations of docs/datasets.md: random, medium and expert of each given environment (default: hopper).
#   docs/make_gifs.sh hopper walker2d halfcheetah ant
set -eu
BIN=${BIN:-.venv/bin}
for env in "${@:-hopper}"; do
    options="--seconds 4 --fps 20 --size 200"
    "$BIN/offbench" video "$env:random" --out "docs/media/$env-random.gif" $options --episodes 99
    "$BIN/offbench" video "$env:medium" --out "docs/media/$env-medium.gif" $options
    "$BIN/offbench" video "$env:expert" --out "docs/media/$env-expert.gif" $options
done
