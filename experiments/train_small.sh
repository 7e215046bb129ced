#!/usr/bin/env bash
# Trains `small` from nothing: its data, the network, the method.
#
#     experiments/train_small.sh --workdir=DIR [--seed=1] [--max_steps=N] ...
#
# Give the same command again after an interruption: what is done is not done again. All
# flags but --workdir go to both trainings. Sizes, optimiser, schedule and the rule that
# ends it are the preset `small` (experiments/presets.py), but for the width: the weights
# that ship are narrower.
set -eo pipefail

if [[ $1 != --workdir=?* ]]; then
    echo "train_small: --workdir=DIR must come first; say where everything goes" >&2
    exit 2
fi
work=${1#*=} flags=("${@:2}")
whole=$work/whole data=$work/data

# make FOLDER SET FLAG...
make() { python -m experiments.make_data --output_dir="$1" --dataset="$2" "${@:3}"; }

# Whole views, which are packed.
make "$whole" shapes
make "$whole" shapes --split=validation
make "$whole" open --partial=clear --num_shapes=6000 --num_views=4
make "$whole" objects --partial=clear --num_views=24
# Views as sensors have them: partly hidden, cut off, noisy and sparse.
make "$data" shapes --partial=mixed --num_shapes=1200
make "$data" open --partial=mixed --num_shapes=2400 --num_views=4
make "$data" objects --partial=mixed
make "$data" cells --num_cells=1500
make "$data" shapes --partial=mixed --split=novel
for name in shapes objects; do make "$data" $name --partial=mixed --split=validation; done
make "$data" cells --split=validation
pack() { python -m experiments.pack --data_dir="$whole" --output_dir="$data" "$@"; }
pack --dataset=shapes --dataset=open --dataset=objects --limit=40000
pack --dataset=shapes --split=validation

width=(--set=model.backbone.features=96 --set=model.backbone.attention_features=48
    '--set=model.backbone.patch_features=((48,96),(96,192))'
    '--set=model.backbone.global_features=(384,384)')

# train PHASE FLAG...
train() {
    local run=$work/$1
    [[ -e $run/weights.safetensors ]] && return
    echo "train: $run"
    "$(dirname "$0")/with_allocator.sh" python -m experiments.train --preset=small \
        --phase="$1" --workdir="$run" --resume --data_dir="$data" \
        --mixture=packed:6,shapes:1,open:1,objects:1,cells:1.5 \
        --validation=packed,shapes/novel,objects,cells "${width[@]}" "${@:2}" \
        "${flags[@]}"
    [[ -e $run/weights.safetensors ]] && return
    echo "stopped; the same command goes on, with more --max_steps or none"
    exit
}
train pretrain
train meta --weights="$work/pretrain/weights.safetensors"
