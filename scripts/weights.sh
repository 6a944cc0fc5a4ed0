#!/usr/bin/env bash
# Makes the weights of `rover` from nothing: renders, then supervised training on them. No photograph is used.
#
#   scripts/weights.sh BARCHAN OUT [DEVICE [STEPS]]
#
# DEVICE is flex by default; tch (a build of `make tch`) takes half the time. What is there already is kept: after a
# stop of any kind the same command goes on.
set -euo pipefail

barchan=$1 out=$2 device=${3:-flex} steps=${4:-5000}
mkdir -p "$out"

# Pairs are rendered once: a step takes as long as rendering the pairs of one.
data=()
render() { # NAME SPEC TIMES
    [ -f "$out/$1/rig.toml" ] || "$barchan" data synth "synth:$2" --out "$out/$1"
    for _ in $(seq "$3"); do data+=(--data "folder:$out/$1"); done
}
ground=width=384,height=288
render scenes1 scenes,seed=21,frames=1000,width=320,height=256 1
render scenes2 scenes,seed=22,frames=1000,width=320,height=256 1
render bare scenes,seed=23,frames=1200,width=320,height=256,bare=3 1
render mars seed=31,frames=120,$ground 2
render arena seed=32,frames=120,look=arena,$ground 2
render devon seed=33,frames=80,look=devon,texture=low,$ground 2

if [ -d "$out/run/checkpoints" ]; then
    "$barchan" train --resume "$out/run" --no-check
else
    "$barchan" train --preset rover --supervised --distribution 5 --cosine --batch 3 --crop 224 288 \
        --epochs 1000 --steps "$steps" --validate-every 500 --device "$device" --no-check --out "$out/run" \
        --add-disparity 24 --asymmetric 0.3 --erase 0.2 --blur 0.6 --flip-swap 0.4 --flip-vertical 0.2 "${data[@]}"
fi
"$barchan" export "$out/run" --out "$out/rover.onnx"
echo "weights: $out/run/weights.safetensors"
