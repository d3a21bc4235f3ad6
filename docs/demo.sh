#!/bin/sh
# The demo: from a shipped behaviour agent to a score table, in the folder ./demo.
# The trainings are short: the curves rise, but the scores do not show how good the algorithms are.
# STEPS=2000 make demo: even shorter.
set -eu
BIN=${BIN:-.venv/bin}
export MINARI_DATASETS_PATH="$PWD/demo/minari" OFFBENCH_CACHE="$PWD/demo/cache"
mkdir -p demo

echo "== recording a small halfcheetah dataset"
"$BIN/offbench" collect halfcheetah --level medium --steps 100000 --overwrite
"$BIN/offbench" show halfcheetah-medium-v0

echo "== training three algorithms on it"
train="--dataset halfcheetah-medium-v0 --runs demo/runs --seeds 0:2 --steps ${STEPS:-6000} --eval-every 500 --eval-episodes 3"
"$BIN/offbench" train bc $train
"$BIN/offbench" train td3_bc $train
"$BIN/offbench" train bdb $train --beta 0.25

echo "== scores"
"$BIN/offbench" normalize --runs demo/runs --plot demo/curves.png
"$BIN/offbench" report --runs demo/runs --out demo/report --title Demo
