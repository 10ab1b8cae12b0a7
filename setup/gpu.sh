#!/bin/sh
# Builds the harness for networks on a GPU. No GPU is needed for that. The compiler is the nvcc in PATH, of CUDA 12.4 or
# newer, or that of `setup/setup.sh --cuda`, which is installed if there is none.
#
#   setup/gpu.sh         builds target/release/harness
#   setup/gpu.sh --pack  also packs what gpu_trial.sh needs into target/gpu, less than 60 MB. Copy this folder to a
#                        machine with a GPU, which needs no Rust, and run setup/gpu_trial.sh there.
#
# DATASETS is a folder of collected datasets for the trial, which otherwise collects its own, through EGL.
# CUDA_COMPUTE_CAP is the compute capability of the oldest GPU that the program is for. If it is not set, it is that of
# this machine's GPU, or 80 (A100) without one.
set -eu
cd "$(dirname "$0")/.."

profile=${PROFILE:-release}
built=target/$([ "$profile" = dev ] && echo debug || echo "$profile")
folder=target/gpu

setup/setup.sh
if ! command -v nvcc >/dev/null; then
    setup/setup.sh --cuda
    CUDA_HOME=$PWD/.venv-cuda/cuda
    PATH=$CUDA_HOME/bin:$PATH
    LIBRARY_PATH=$CUDA_HOME/lib64
    export CUDA_HOME PATH LIBRARY_PATH
fi
if [ -z "${CUDA_COMPUTE_CAP-}" ] && ! command -v nvidia-smi >/dev/null; then
    export CUDA_COMPUTE_CAP=80
fi

cargo build --profile "$profile" --features cuda --bin harness
[ "${1-}" = --pack ] || exit 0

cargo build --profile "$profile" --features cuda --example training_step
test=$(cargo test --profile "$profile" --features cuda -p harness-learning --test gpu --no-run --message-format json |
    sed -n 's/.*"executable":"\([^"]*\/gpu-[^"]*\)".*/\1/p')
rm -rf $folder
mkdir -p $folder/bin $folder/lib
strip -o $folder/bin/harness "$built/harness"
strip -o $folder/bin/training_step "$built/examples/training_step"
strip -o $folder/bin/ops_on_gpu "$test"
cp .venv/mujoco/libmujoco.so.* $folder/lib/
tar -C $folder -cf - bin lib | xz -T0 -6 >$folder/programs.tar.xz
rm -r $folder/bin $folder/lib
[ -z "${DATASETS-}" ] || cp -r "$DATASETS" $folder/datasets
for path in harness/benches tests/fixtures/twin.py experiments setup/gpu_trial.sh; do
    mkdir -p "$folder/$(dirname $path)"
    cp -r $path "$folder/$path"
done
du -sm $folder
