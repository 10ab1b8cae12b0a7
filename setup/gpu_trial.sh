#!/bin/bash
# Tests and measures the harness on a machine with a GPU, and compares it with PyTorch there. Needs the folder that
# `setup/gpu.sh --pack` makes, in which this script lies, Python with torch and pyarrow, and CUDA's libraries, which may
# be those that pip installs with torch.
#
#   setup/gpu_trial.sh                 all steps, in half an hour
#   setup/gpu_trial.sh ops smoke       some of them
#   MATCH=deep setup/gpu_trial.sh steps epochs
#
# The steps are the functions of harness/benches/gpu.py. A step that fails or takes too long does not stop the others.
# The measurements are in $OUT/gpu.parquet, the metrics' differences in $OUT/gpu_metrics.parquet, and the output in
# $OUT/gpu.txt. OUT is the folder `out` by default.
set -u
cd "$(dirname "$0")/.."

export OUT=${OUT:-$PWD/out} TRIAL=${TRIAL:-/tmp/gpu_trial} PYTHONUNBUFFERED=1
export TORCHINDUCTOR_CACHE_DIR=$TRIAL/inductor
mkdir -p "$OUT" "$TRIAL"

if ! cmp -s programs.tar.xz "$TRIAL/programs.tar.xz"; then
    python3 -c 'import sys, tarfile; tarfile.open("programs.tar.xz").extractall(sys.argv[1])' "$TRIAL"
    cp programs.tar.xz "$TRIAL"
fi
# An EGL loader, if the folder contains its packages and the machine has none.
for package in gl/*.deb; do
    [ -e "$package" ] && [ ! -d "$TRIAL/gl" ] && dpkg -x "$package" "$TRIAL/gl.part"
done
[ ! -d "$TRIAL/gl.part" ] || mv "$TRIAL/gl.part" "$TRIAL/gl"
# For the programs only: PyTorch finds its own libraries, which are among these.
packages=$(python3 -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
LIBRARIES=$(ls -d "$TRIAL/lib" "$TRIAL"/gl/usr/lib/*-linux-gnu "$packages"/nvidia/*/lib /usr/local/cuda/lib64 \
    /usr/local/nvidia/lib64 2>/dev/null | tr '\n' ':')
export LIBRARIES
vendor=/usr/local/nvidia/share/glvnd/egl_vendor.d/10_nvidia.json
[ ! -e $vendor ] || export __EGL_VENDOR_LIBRARY_FILENAMES=${__EGL_VENDOR_LIBRARY_FILENAMES:-$vendor}

# Seconds that a step may take.
declare -A limits=([machine]=60 [prepare]=300 [ops]=240 [smoke]=120 [interrupt]=150 [two]=100 [memory]=150
    [render]=240 [steps]=560 [autotune]=360 [epochs]=500 [paper]=300)

step() {
    echo "== $1 $(date -u +%T)"
    timeout --kill-after=10 "${limits[$1]}" python3 harness/benches/gpu.py "$1"
    local code=$?
    echo "== $1 ended with $code $(date -u +%T)"
}

[ $# -gt 0 ] || set -- prepare ops smoke interrupt two memory render steps epochs paper
for name in "$@"; do
    [ -n "${limits[$name]-}" ] || { echo "unknown step $name; steps: ${!limits[*]}"; exit 2; }
done

all_steps() {
    step machine
    prepared=
    for name in "$@"; do
        case $name in
        machine) ;;
        # Compiles PyTorch's networks while the harness is tested.
        prepare) step prepare & prepared=$! ;;
        memory | steps | autotune | epochs | paper)
            [ -z "$prepared" ] || wait "$prepared"
            prepared=
            step "$name"
            ;;
        *) step "$name" ;;
        esac
    done
    [ -z "$prepared" ] || wait "$prepared"
}

all_steps "$@" 2>&1 | tee -a "$OUT/gpu.txt"
