#!/bin/sh
# The demo: from a shipped behaviour agent to a score table, in the folder ./demo.
# The trainings are short: the scores show that everything works, not how good the algorithms are.
set -eu
BIN=${BIN:-.venv/bin}
export MINARI_DATASETS_PATH="$PWD/demo/minari" OFFBENCH_CACHE="$PWD/demo/cache"
mkdir -p demo

echo "== recording a small hopper dataset"
"$BIN/offbench" collect hopper --level medium --steps 100000 --overwrite
"$BIN/offbench" show hopper-medium-v0

echo "== training three algorithms on it"
train="--dataset hopper-medium-v0 --runs demo/runs --eval-episodes 5"
"$BIN/offbench" train td3_bc $train --steps 6000 --eval-every 2000
"$BIN/offbench" train bdb $train --steps 6000 --eval-every 2000 --beta 0.25
"$BIN/offbench" train cql $train --steps 300 --eval-every 100 --bc-steps 100 --actor-learning-rate 3e-4

echo "== scores"
"$BIN/offbench" normalize --runs demo/runs --plot demo/curves.png
echo "to see them as a page: $BIN/offbench report --runs demo/runs"
