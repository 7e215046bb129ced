#!/usr/bin/env bash
# Trains weights for a release, from scratch or from other weights: trains, trains a
# control on as many samples without the method, scores both, and exports them.
#
#     experiments/train_release.sh --workdir=DIR --preset=small [--weights=FILE] ...
#
# After an interruption, repeat the command: finished steps are skipped and trainings
# resume. Other arguments are rejected. Its own flags:
#
#     --workdir=DIR          output folder
#     --name=NAME            of the weights; default: the preset's
#     --weights=NAME|FILE    initial weights; default: from scratch
#     --scored=SET[=FOLDER]  data set to score on; repeatable; default: shapes
#     --scored_at_once=N     examples, as memory allows
#     --branches=LIST        also meta-train with these branches alone, as align,normal
#                            (Table III); again for others
#
# All others go to every training: --preset, --seed, --dataset, --data_dir, --set, ...
set -eo pipefail

fail() {
    echo "train_release: $1; $2" >&2
    exit 2
}

workdir='' name=small start=() scored=() at_once=20 branches=() flags=()
for flag in "$@"; do
    value=${flag#*=}
    case $flag in
    --workdir=*) workdir=$value ;;
    --name=*) named=$value ;;
    --weights=*) start=("$flag") ;;
    --scored=*) scored+=("$value") ;;
    --scored_at_once=*) at_once=$value ;;
    --branches=*) branches+=("$value") ;;
    --preset=*) name=$value flags+=("$flag") ;;
    --?*=*) flags+=("$flag") ;;
    *) fail "$flag: not a flag" "write flags as --name=value" ;;
    esac
done
for part in ${branches[*]//,/ }; do
    [[ $part =~ ^(normal|denoise|align)$ ]] ||
        fail "--branches: unknown value $part" "use normal, denoise, align"
done
[[ $workdir ]] || fail "--workdir: missing" "set the output folder"
name=${named:-$name}

# Builds and opens a set's splits that no training sees, and prints their names.
splits() {
    python -c '
import sys
import experiments  # which tells faults in one line
from prism_jax.data.datasets import open_dataset, scored_splits
from experiments.simulation.build_dataset import build_if_missing
name, folder = sys.argv[1], sys.argv[2] or None
for split in scored_splits(name):
    build_if_missing(name, split, folder)
    open_dataset(name, split, folder)
    print(split)' "$1" "$2"
}

# What is to be scored on is opened first: a mistake would else show after days.
tests=()
for place in "${scored[@]:-shapes}"; do
    set=${place%%=*} folder=${place#"$set"}
    found=$(splits "$set" "${folder#=}")
    for split in $found; do tests+=("$set $split ${folder#=}"); done
done

mkdir -p "$workdir"
# A run that was bounded goes on with another bound.
arguments=$(printf '%s\n' "$@" | grep -v '^--max_steps=')
if [[ -e $workdir/pretrained/config.json ]]; then
    [[ $arguments == "$(<"$workdir/arguments.txt")" ]] ||
        fail "$workdir: was begun with other arguments" "give those of arguments.txt"
fi
echo "$arguments" >"$workdir/arguments.txt"

# The change with which the losses of these branches count, and no others.
only() {
    echo "--set=meta.method.branches=('$(sed "s/,/','/g" <<<"$1")',)"
}

# train PHASE FOLDER FLAG...
train() {
    local run=$workdir/$2
    [[ -e $run/weights.safetensors ]] && return
    echo "train: $run"
    python -m experiments.train --phase="$1" --workdir="$run" --resume "${flags[@]}" \
        "${@:3}"
    if [[ ! -e $run/weights.safetensors ]]; then
        echo "stopped; the same command goes on, with more --max_steps or none"
        exit
    fi
}

# release FOLDER NAME
release() {
    local weights=$workdir/$1/weights.safetensors results=()
    for test in "${tests[@]}"; do
        read -r set split folder <<<"$test"
        local output=$workdir/$1-$set-$split.json
        results+=("--scores=$output")
        [[ $output -nt $weights ]] && continue
        echo "evaluate: $output"
        python -m experiments.evaluate --weights="$weights" --dataset="$set" \
            --split="$split" ${folder:+--data_dir="$folder"} \
            --batch_size="$at_once" --output="$output"
    done
    python -m experiments.release --weights="$weights" --name="$2" \
        --output_dir="$workdir" "${results[@]}"
}

train pretrain pretrained "${start[@]}"
start=("--weights=$workdir/pretrained/weights.safetensors")
train meta meta "${start[@]}"
train meta control "${start[@]}" --set=meta.method.num_steps=0 \
    --set=meta.method.lambda_aux=0.0 --set=meta.method.learn_steps=False \
    --set=meta.method.learn_auxiliary=False --set=adapt.num_steps=0
for branch in "${branches[@]}"; do
    train meta "meta-${branch//,/-}" "${start[@]}" "$(only "$branch")"
done

release meta "$name"
release control "$name-pretrained"
for branch in "${branches[@]}"; do
    release "meta-${branch//,/-}" "$name-${branch//,/-}"
done
