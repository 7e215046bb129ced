#!/usr/bin/env bash
# How `small` was trained: its data and its eleven trainings in order, from nothing to
# prism_jax/assets/small.safetensors.
#
#     experiments/train_small.sh --workdir=DIR [--num_workers=N] ...
#
# Give the same command again after an interruption: what is done is not done again. All
# flags but --workdir go to every training. Each ran at the commit beside it, and the code
# has changed since: the same command gives similar weights, not the same bytes.
set -eo pipefail

if [[ $1 != --workdir=?* ]]; then
    echo "train_small: --workdir=DIR must come first; say where everything goes" >&2
    exit 2
fi
work=${1#*=} flags=("${@:2}") began='' latest=''
whole=$work/whole clear=$work/clear data=$work/data more=$work/more

# make FOLDER SET FLAG... and pack FROM TO FLAG...
make() { python -m experiments.make_data --output_dir="$1" --dataset="$2" "${@:3}"; }
pack() { python -m experiments.pack --data_dir="$1" --output_dir="$2" "${@:3}"; }

# train NAME FLAG... goes on from the latest weights.
train() {
    local run=$work/$1
    began=$latest latest=$run/weights.safetensors
    [[ -e $latest ]] && return
    echo "train: $run"
    "$(dirname "$0")/with_allocator.sh" python -m experiments.train --preset=small \
        --workdir="$run" --resume ${began:+"--weights=$began"} "${@:2}" "${flags[@]}"
    [[ -e $latest ]] && return
    echo "stopped; the same command goes on, with more --max_steps or none"
    exit
}

# between NAME SHARE goes so far from what the latest training began with to its end.
between() {
    local output=$work/$1.safetensors
    [[ -e $output ]] || python -m experiments.interpolate --start="$began" \
        --end="$latest" --share="$2" --output="$output"
    latest=$output
}

# stages NAME SAMPLES FLAG... trains the whole decoder alone.
stages() {
    train "$1" --set=pretrain.backbone.0.num_samples=0 --set=pretrain.auxiliary_samples=0 \
        --set=pretrain.backbone.1.num_samples="$2" "${@:3}"
}

# Whole views of 12,000 shapes, eight of each.
for split in train validation; do make "$whole" shapes --split=$split; done
near=(--data_dir="$whole" --set=model.backbone.seeds_read_visibility=False
    --set=model.backbone.offset_reach=1.0)
blind=("${near[@]}" --set=model.backbone.reads_visibility=False --set=model.heading=given
    --set=pretrain.average_decay=0.0)
control=(--phase=meta --set=meta.method.num_steps=0 --set=meta.method.lambda_aux=0.0
    --set=meta.method.learn_steps=False --set=meta.method.learn_auxiliary=False
    --set=adapt.num_steps=0)
short=(--set=meta.num_samples=8000 --set=meta.validate_every=2000)
# Seeds, stages and auxiliary branches, from nothing (6cf0dc0).
train 01 "${blind[@]}" --set=pretrain.backbone.0.num_samples=96000 \
    --set=pretrain.backbone.1.num_samples=160000 --set=pretrain.auxiliary_samples=16000
# The control of a meta-training: as many samples without the method (0684741).
train 02 "${blind[@]}" "${control[@]}" --set=meta.num_samples=24000
stages 03 240000 "${blind[@]}" # More samples (3a203c6).
stages 04 416000 "${blind[@]}" # And more (84472fb).
# The same at a third of the step size, and new auxiliary branches (b6d34af).
stages 05 64000 "${blind[@]}" --set=pretrain.backbone.1.learning_rate=3e-4 \
    --set=pretrain.auxiliary_samples=20000
train 06 "${blind[@]}" "${control[@]}" "${short[@]}" # Again a control (b6d34af).
# Any heading, and a decoder that reads what the sensor knows (b304c05).
stages 07 160000 "${near[@]}"
# Meta-training (b304c05): small-whole, which shipped as small until 8eee0ac.
train 08 --phase=meta "${near[@]}" "${short[@]}"

# Clear views, which are packed, and views as sensors have them, partly hidden, cut off,
# noisy and sparse: of shapes, open shapes, objects that people modelled, and robot cells.
make "$clear" shapes --partial=clear --num_shapes=4000 --num_views=4
make "$clear" open --partial=clear --num_shapes=3000 --num_views=4
make "$data" shapes --partial=mixed --num_shapes=1200
make "$data" open --partial=mixed --num_shapes=2400 --num_views=4
make "$data" cells --num_cells=1500
make "$data" cells --split=validation
for part in "$clear clear" "$data mixed"; do
    for given in objects "objects --split=validation" "shapes --split=validation"; do
        make "${part% *}" $given --partial="${part##* }"
    done
done
pack "$clear" "$data" --dataset=shapes --dataset=open --dataset=objects
pack "$clear" "$data" --dataset=shapes --dataset=objects --split=validation
rate=--set=pretrain.backbone.1.learning_rate=6e-4 sets=shapes:1,open:1,objects:1,cells:1.5
# On all of that, and 0.8 of the way (afa12bf, 737c14d): small-occluded.
stages 09 120000 --mixture="packed:4,$sets" --data_dir="$data" $rate
between small-occluded 0.8
# More samples, more of them clear, and 0.75 of the way (cb34078, e24a6ba): small-longer.
stages 10 224000 --mixture="packed:5,$sets" --data_dir="$data" $rate
between small-longer 0.75

# The same sets, but packed are whole views of all shapes, and more of the others.
make "$whole" open --partial=clear --num_shapes=6000 --num_views=4
make "$whole" objects --partial=clear --num_views=24
mkdir -p "$more"
for part in {shapes,open,objects,cells}-train {shapes,objects,cells}-validation validation; do
    ln -sfn "$(realpath -m "$data/$part")" "$more/$part"
done
pack "$whole" "$more" --dataset=shapes --dataset=open --dataset=objects --limit=40000
# On those, and 0.75 of the way (962f44a). All shares were chosen on validation.
stages 11 152000 --mixture="packed:6,$sets" --data_dir="$more" $rate
between small 0.75
