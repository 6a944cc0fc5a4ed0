#!/usr/bin/env bash
# The main job, from images to terrain: train, export, infer, slam, map, and the trajectory scored
# where its truth is known. Its own results of an earlier run are replaced.
#
#     main-job.sh BARCHAN DATA OUT
set -euo pipefail

barchan=$1 data=$2 out=$3

step() { # step TITLE ARGUMENTS...: one command of barchan, as anybody could type it
    printf '\n== %s\nbarchan %s\n' "$1" "${*:2}"
    "$barchan" "${@:2}"
}

mkdir -p "$out"
rm -rf "$out"/{train,infer,slam,map,model.onnx,report.html}

# Rendered data go to disk first, so that the images can be looked at and the truth is a file.
if [[ $data == synth:* || $data == synth ]]; then
    rm -rf "$out/data"
    step "Render a rover traverse" data synth "$data" --out "$out/data"
    data=folder:$out/data
fi

step "Train on the images alone" train --data "$data" --epochs 1 --finetune --preset tiny --out "$out/train"
step "Export the network" export "$out/train" --out "$out/model.onnx"
step "Disparity" infer --data "$data" --model "$out/model.onnx" --out "$out/infer"
step "Trajectory" slam --data "$data" --model "$out/model.onnx" --out "$out/slam"
step "Terrain" map "$out/slam" --out "$out/map"

against=()
for truth in groundtruth.tum gt.csv poses.txt; do
    if [[ -f ${data#folder:}/$truth ]]; then
        step "Trajectory against the truth" eval trajectory --est "$out/slam/trajectory.tum" --gt "${data#folder:}/$truth"
        against=(--gt "${data#folder:}/$truth")
        break
    fi
done

step "Report" report "$out/slam" --map "$out/map" "${against[@]}" --out "$out/report.html"

cat <<END

Done. Where to look:
  $out/report.html       everything on one page
  $out/infer             disparity, confidence, colour previews, a cloud of points per frame
  $out/slam              trajectory.tum, summary.json
  $out/map/cloud.ply     the ground in colour (CloudCompare, MeshLab)
  $out/map/dem.tif       its heights, and hillshade.tif beside it (QGIS)
END
