#!/usr/bin/env bash
# Which corpus helps under shift? Trains `small` on six mixtures of data, which differ by
# one thing each, and scores each on validation data that no training saw: new kinds,
# people's models, robot cells, and new shapes of the kinds trained on.
#
#     experiments/train_mixtures.sh --workdir=DIR --weights=NAME [--samples=250000] ...
#     python -m experiments.mixtures --workdir=DIR --output=docs/tables/mixtures.json
#
# After an interruption give the same command again: what is done is not done again. Its
# own flags:
#
#     --workdir=DIR     where everything goes, the data with views as sensors have them
#                       in DIR/data among it
#     --samples=N       of each training; 250,000 if not given
#     --weights=NAME    what all go on from, a name or a file
#     --only=NAME       one of the six, again for others; all if not given
#     --num_shapes=N    to build of shapes, and of open shapes; 12,000 if not given
#     --num_cells=N     to build; 4,000 if not given
#
# All others go to every training.
set -eo pipefail

fail() {
    echo "train_mixtures: $1; $2" >&2
    exit 2
}

workdir='' samples=250000 weights='' only=() flags=()
num_shapes=12000 num_cells=4000
for flag in "$@"; do
    value=${flag#*=}
    case $flag in
    --workdir=*) workdir=$value ;;
    --samples=*) samples=$value ;;
    --weights=*) weights=$value ;;
    --only=*) only+=("$value") ;;
    --num_shapes=*) num_shapes=$value ;;
    --num_cells=*) num_cells=$value ;;
    --?*=* | --tensorboard) flags+=("$flag") ;;
    *) fail "$flag: is no flag" "write --name=value for each" ;;
    esac
done
[[ $workdir ]] || fail "--workdir: is missing" "say where everything goes"
[[ $weights ]] || fail "--weights: is missing" "say what all trainings go on from"
data=$workdir/data

# What each is trained on, as flags of experiments.pretrain.
declare -A mixtures=(
    [today]="--dataset=shapes --set=model.heading=given"
    [poses]="--dataset=shapes --set=model.heading=level"
    [occluded]="--mixture=shapes:1 --data_dir=$data --set=model.heading=level"
    [open]="--mixture=shapes:1,open:1 --data_dir=$data --set=model.heading=level"
    [models]="--mixture=shapes:1,objects:1 --data_dir=$data --set=model.heading=level"
    [all]="--mixture=shapes:2,open:2,objects:1,cells:1 --data_dir=$data --set=model.heading=level"
)
names=(today poses occluded open models all)
for name in "${only[@]}"; do
    [[ ${mixtures[$name]} ]] || fail "--only: $name is none" "use ${names[*]}"
done
(( ${#only[@]} )) && names=("${only[@]}")

# build SET SPLIT FLAG...
build() {
    python -m experiments.make_data --dataset="$1" --split="$2" --output_dir="$data" \
        "${@:3}"
}

for name in "${names[@]}"; do
    case $name in occluded | open | models | all)
        build shapes train --partial=mixed --num_shapes="$num_shapes"
        build shapes validation --partial=mixed
        ;;
    esac
    case $name in open | all)
        build open train --partial=mixed --num_shapes="$num_shapes" ;;
    esac
    case $name in models | all)
        build objects train --partial=mixed
        build objects validation --partial=mixed
        ;;
    esac
    case $name in all)
        build cells train --num_cells="$num_cells"
        build cells validation
        ;;
    esac
    run=$workdir/$name
    # Split on blanks.
    read -ra own <<<"${mixtures[$name]}"
    if [[ ! -e $run/weights.safetensors ]]; then
        echo "pretrain: $run"
        "$(dirname "$0")/with_allocator.sh" python -m experiments.pretrain \
            --preset=small --weights="$weights" --workdir="$run" --resume "${own[@]}" \
            --set=pretrain.backbone.0.num_samples=0 \
            --set=pretrain.backbone.1.num_samples="$samples" \
            --set=pretrain.auxiliary_samples=0 "${flags[@]}"
    fi
    for place in shapes/novel objects/validation roboarm/validation shapes/validation; do
        output=$run/${place/\//-}.json
        [[ -e $output && ! $run/weights.safetensors -nt $output ]] && continue
        echo "evaluate: $output"
        python -m experiments.evaluate --weights="$run/weights.safetensors" --steps=0 \
            --dataset="${place%/*}" --split="${place#*/}" --output="$output"
    done
done
