#!/bin/sh
# Installs what cargo cannot: a virtual environment with MuJoCo, links to its library, and an EGL driver.
# It installs only what is missing, so a second call takes about a second.
#
#   setup/setup.sh                installs what the harness needs
#   setup/setup.sh --test         also what its tests need
#   setup/setup.sh --python       also what building and testing the Python package needs
#   setup/setup.sh --docs         also what building the documentation site needs
#   setup/setup.sh --bench        also .venv-bench, with PyTorch and PyBullet for the benchmarks
#   setup/setup.sh --interchange  also .venv-interchange, with LeRobot, Rerun, MLflow, TensorBoard, recordings' readers
#   setup/setup.sh --cluster      also Slurm, for its tests
#   setup/setup.sh --notebooks    also .venv-notebooks, with Stable-Baselines3 and Jupyter
#   setup/setup.sh --wheel        also .venv-wheel, with what builds a wheel
#   setup/setup.sh --cuda         also .venv-cuda/cuda, a CUDA toolkit for building with `--features cuda`
#   setup/setup.sh --models       also .venv-models, with other people's robot models for the tests
set -eu
cd "$(dirname "$0")/.."

# All packages in requirements.txt have wheels for these versions of Python. The first version is preferred.
pythons='3.11 3.12'
mujoco_library=libmujoco.so.$(sed -n 's/^mujoco==//p' setup/requirements.in)

say() { echo "setup: $*" >&2; }

fail() {
    say "$@"
    exit 1
}

# Runs a command as root: directly, or through sudo if sudo needs no password.
as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    else
        sudo -n "$@"
    fi
}

can_install() { command -v apt-get >/dev/null && as_root true 2>/dev/null; }

apt_install() {
    say "installing $* with apt-get"
    as_root apt-get update -qq
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends "$@" >/dev/null
}

check_rust() {
    needed=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    command -v cargo >/dev/null && command -v rustc >/dev/null ||
        fail "cargo or rustc is missing; install Rust $needed or newer (https://rustup.rs)"
    found=$(rustc --version | cut -d ' ' -f 2)
    [ "$(printf '%s\n%s\n' "$needed" "$found" | sort -V | head -n 1)" = "$needed" ] ||
        fail "rustc $found is too old; install Rust $needed or newer (rustup update stable)"
}

# Prints the first Python interpreter of a supported version.
find_python() {
    for version in $pythons; do
        for name in "python$version" python3 "/usr/bin/python$version"; do
            if "$name" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$version')" 2>/dev/null; then
                echo "$name"
                return
            fi
        done
    done
    fail "no Python found; install one of: $pythons"
}

# Makes a virtual environment in the folder $1, unless it exists and works.
make_venv() {
    # In a copied or incomplete environment, the interpreter doesn't run or pip is missing.
    "$1/bin/python" -c 'import pip' 2>/dev/null && return
    python=$(find_python)
    if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        can_install || fail "$python cannot make virtual environments; install it as root: apt-get install $package"
        apt_install "$package"
    fi
    say "making $1 with $("$python" --version)"
    "$python" -m venv --clear "$1"
}

# Installs the lock file setup/$2 into the environment $1, unless it was the last one installed there. Further arguments
# are pip's.
install_packages() {
    lock=setup/$2
    installed=$1/installed-$2
    environment=$1
    shift 2
    cmp -s "$lock" "$installed" && return
    say "installing the Python packages of $lock"
    "$environment/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes -r "$lock" "$@"
    cp "$lock" "$installed"
}

# The wheel contains the library only under its versioned name. The mujoco-rs crate also needs the name libmujoco.so.
link_mujoco() {
    library=$(cd .venv && echo lib/python3*/site-packages/mujoco/$mujoco_library)
    [ -e ".venv/$library" ] || fail "there is no $mujoco_library in .venv; remove .venv and run setup again"
    mkdir -p .venv/mujoco
    for name in libmujoco.so $mujoco_library; do
        [ "$(readlink ".venv/mujoco/$name")" = "../$library" ] || ln -sfn "../$library" ".venv/mujoco/$name"
    done
}

# Succeeds if an OpenGL context can be made without a display, as the harness does.
egl_works() {
    MUJOCO_GL=egl .venv/bin/python -c 'import mujoco; mujoco.GLContext(8, 8).make_current()' 2>/dev/null
}

check_egl() {
    packages='libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0'
    egl_works && return
    # shellcheck disable=SC2086 # a list of packages
    if can_install; then apt_install $packages || true; fi
    egl_works ||
    fail "no EGL driver answers, so frames can't be rendered; install one as root: apt-get install $packages"
}

# Tests read the report's page in a browser. Without one they are skipped.
check_browser() {
    command -v chromedriver >/dev/null && return
    if can_install; then apt_install chromium chromium-driver fonts-liberation || true; fi
    command -v chromedriver >/dev/null ||
        say 'no Chromium with its driver, so the tests that read the report in it are skipped; install both as root:' \
            'apt-get install chromium chromium-driver'
}

# A Slurm cluster on this machine, for its own tests.
check_slurm() {
    packages='slurmctld slurmd slurm-client munge'
    command -v sbatch >/dev/null && return
    # shellcheck disable=SC2086 # a list of packages
    if can_install; then apt_install $packages || true; fi
    command -v sbatch >/dev/null || fail "Slurm is missing; install it as root: apt-get install $packages"
}

# The packages have the libraries only under their versioned names, and lack the driver's library, which only machines
# with a GPU have. The linker needs its name and its functions' names.
link_cuda() {
    packages=$(cd .venv-cuda && echo lib/python3*/site-packages/nvidia/cu13)
    toolkit=.venv-cuda/cuda
    mkdir -p $toolkit/lib64
    for folder in bin include nvvm; do ln -sfn "../$packages/$folder" "$toolkit/$folder"; done
    for library in ".venv-cuda/$packages"/lib/lib*.so.*; do
        name=$(basename "$library")
        ln -sfn "../../$packages/lib/$name" "$toolkit/lib64/$name"
        ln -sfn "$name" "$toolkit/lib64/${name%%.so.*}.so"
    done
    [ -e $toolkit/lib64/libcuda.so ] && return
    command -v cc >/dev/null || fail 'a C compiler is missing; install one as root: apt-get install gcc g++'
    grep -oE '\bcu[A-Z][A-Za-z0-9_]*' $toolkit/include/cuda.h | sort -u | sed 's/.*/void &(void) {}/' |
        cc -shared -fPIC -w -Wl,-soname,libcuda.so.1 -x c -o $toolkit/lib64/libcuda.so -
}

check_rust
make_venv .venv
install_packages .venv requirements.txt
link_mujoco
case ${1-} in
--test)
    install_packages .venv requirements-test.txt
    check_browser
    ;;
--cluster)
    install_packages .venv requirements-python.txt
    check_slurm
    ;;
--python) install_packages .venv requirements-python.txt ;;
--docs)
    install_packages .venv requirements-python.txt
    install_packages .venv requirements-docs.txt
    ;;
--bench)
    make_venv .venv-bench
    install_packages .venv-bench requirements-bench.txt
    ;;
--interchange)
    pythons=3.12 # the oldest version that LeRobot supports
    make_venv .venv-interchange
    install_packages .venv-interchange requirements-interchange.txt
    ;;
--notebooks)
    make_venv .venv-notebooks
    install_packages .venv-notebooks requirements-notebooks.txt
    ;;
--wheel)
    make_venv .venv-wheel
    install_packages .venv-wheel requirements-wheel.txt
    ;;
--cuda)
    make_venv .venv-cuda
    install_packages .venv-cuda requirements-cuda.txt
    link_cuda
    ;;
--models)
    make_venv .venv-models
    install_packages .venv-models requirements-models.txt --no-deps
    ;;
esac
check_egl
