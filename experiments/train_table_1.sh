#!/usr/bin/env bash
# Trains every network of Table I from nothing, on as many samples of the same data each:
# those to compare with, the backbone alone as CRA-PCN has it, and ours, which is told what
# the sensor knows. Its auxiliary modules see 20,000 samples more.
#
#     experiments/train_table_1.sh --workdir=DIR [--samples=500000] [--only=NAME] ...
#
# After an interruption give the same command again: what is done is not done again, and
# a training goes on where it was. At its end it prints the command of the table. Its own
# flags:
#
#     --workdir=DIR    where everything goes
#     --samples=N      of each network; 500,000 if not given
#     --only=NAME      pcn, pointr, seedformer, fsc, crapcn or prism, again for
#                      others; all if not given
#
# All others go to every training: --mixture, --data_dir, --seed, --set, ...
set -eo pipefail

fail() {
    echo "train_table_1: $1; $2" >&2
    exit 2
}

others=(pcn pointr seedformer fsc)
workdir='' samples=500000 only=() flags=()
for flag in "$@"; do
    value=${flag#*=}
    case $flag in
    --workdir=*) workdir=$value ;;
    --samples=*) samples=$value ;;
    --only=*) only+=("$value") ;;
    --?*=*) flags+=("$flag") ;;
    *) fail "$flag: not a flag" "write flags as --name=value" ;;
    esac
done
[[ $workdir ]] || fail "--workdir: missing" "set the output folder"
[[ $samples =~ ^[1-9][0-9]*$ ]] || fail "--samples: is $samples" "give a whole number"
names=("${others[@]}" crapcn prism)
for name in "${only[@]}"; do
    [[ " ${names[*]} " == *" $name "* ]] || fail "--only: $name is none" "use ${names[*]}"
done
(( ${#only[@]} )) && names=("${only[@]}")

# train NAME COMMAND FLAG...
train() {
    local run=$workdir/$1
    [[ -e $run/weights.safetensors ]] && return
    echo "$2: $run"
    "$(dirname "$0")/with_allocator.sh" python -m "experiments.$2" --preset=small \
        --workdir="$run" --resume "${@:3}" "${flags[@]}"
    if [[ ! -e $run/weights.safetensors ]]; then
        echo "stopped; the same command goes on, with more --max_steps or none"
        exit
    fi
}

# One phase, as the other networks have.
phases=(
    --set=pretrain.backbone.0.num_samples=0
    --set=pretrain.backbone.1.num_samples=$samples
)
alone=(--set=model.backbone.seeds_read_visibility=False
    --set=model.backbone.reads_visibility=False
    --set=pretrain.auxiliary_samples=0)
for name in "${names[@]}"; do
    case $name in
    crapcn) train crapcn train "${phases[@]}" "${alone[@]}" ;;
    prism) train prism train "${phases[@]}" ;;
    *) train "$name" train_baseline --network="$name" --samples="$samples" ;;
    esac
done
echo "python -m experiments.table_1$(printf " --network=$workdir/%s/weights.safetensors" "${others[@]}")" \
    "--backbone=$workdir/crapcn/weights.safetensors" \
    "--weights=$workdir/prism/weights.safetensors --longer=small --output=FILE.json"
