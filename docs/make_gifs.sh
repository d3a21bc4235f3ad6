#!/bin/sh
# The moving pictures of docs/datasets.md: random, medium and expert of each environment given (default: hopper).
#   docs/make_gifs.sh hopper walker2d halfcheetah
set -eu
BIN=${BIN:-.venv/bin}
for env in "${@:-hopper}"; do
    film="--seconds 4 --fps 20 --size 200"
    "$BIN/offbench" video "$env:random" --out "docs/media/$env-random.gif" $film --episodes 99
    "$BIN/offbench" video "$env:medium" --out "docs/media/$env-medium.gif" $film
    "$BIN/offbench" video "$env:expert" --out "docs/media/$env-expert.gif" $film
done
