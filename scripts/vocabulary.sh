#!/usr/bin/env bash
# Learns the shipped vocabulary: the visual words of ORB features, from rendered traverses only.
# usage: scripts/vocabulary.sh BARCHAN OUT
set -euo pipefail
barchan=$1 out=$2
data=()
for seed in 101 102 103 104; do
    for look in mars moon arena devon; do
        for texture in rich real; do
            route=circle
            [ $((seed % 2)) = 0 ] && route=loop
            data+=(--data "synth:seed=$seed,look=$look,texture=$texture,route=$route,speed=1.5,noise=2,frames=48")
        done
    done
done
"$barchan" vocabulary "${data[@]}" --every 4 --out "$out"
