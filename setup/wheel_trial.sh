#!/bin/sh
# Installs the wheel in a bare Debian that has Python and nothing else, and runs an experiment there from an empty
# folder, as a new user would. Prints how long each step took. Needs root, debootstrap, Debian's packages and the Python
# package registry.
#
#   setup/wheel_trial.sh              in Debian 12 (bookworm, Python 3.11, glibc 2.36)
#   setup/wheel_trial.sh trixie       in Debian 13 (Python 3.13, glibc 2.41)
#
# The bare Debian is kept in target/wheel-trial. Later trials begin with a copy of it.
set -eu
cd "$(dirname "$0")/.."

suite=${1:-bookworm}
bare=$PWD/target/wheel-trial/$suite
root=$bare-trial

fail() {
    echo "wheel trial: $*" >&2
    exit 1
}

# Runs a shell command in the bare Debian, in the empty folder.
inside() {
    chroot "$root" env -i HOME=/root LANG=C.UTF-8 PATH=/venv/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        PIP_DEFAULT_TIMEOUT="${PIP_DEFAULT_TIMEOUT:-15}" sh -c "mkdir -p /empty && cd /empty && $1"
}

# The same, with the command and its time.
timed() {
    echo "\$ $1"
    begin=$(date +%s%N)
    inside "$1"
    awk "BEGIN { printf \"(%.1f s)\n\", ($(date +%s%N) - $begin) / 1e9 }"
}

[ "$(id -u)" -eq 0 ] || fail 'chroot needs root'
command -v debootstrap >/dev/null || fail 'debootstrap is missing; install it as root: apt-get install debootstrap'
ls dist/soft_harness-*.whl >/dev/null 2>&1 || fail 'there is no wheel; build it: make wheel'
# In a mount namespace of its own, the system forgets the mounts when this script ends.
[ "${WHEEL_TRIAL:-}" = inside ] || WHEEL_TRIAL=inside exec unshare --mount "$0" "$@"

if [ ! -d "$bare" ]; then
    mkdir -p "$(dirname "$bare")"
    rm -rf "$bare.part"
    debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates "$suite" "$bare.part" \
        >"$bare.log" 2>&1 ||
        fail "debootstrap failed; see $bare.log"
    mv "$bare.part" "$bare"
fi
rm -rf "$root"
cp -a "$bare" "$root"
# The network and the certificates of this machine.
cp /etc/resolv.conf /etc/hosts "$root/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
if [ -e /etc/pip.conf ]; then cp /etc/pip.conf "$root/etc/"; fi
mkdir "$root/dist"
cp dist/soft_harness-*.whl "$root/dist/"
mount -t proc proc "$root/proc"
mount --bind /dev "$root/dev"

inside '! command -v cc gcc clang rustc cargo make git' || fail 'the Debian is not bare'
timed 'python3 --version'
timed 'python3 -m venv /venv'
timed 'pip install --quiet --disable-pip-version-check /dist/soft_harness-*.whl'
timed 'harness --version'
timed 'harness experiments | tail -n 4'
timed 'harness world list'

# Without an OpenGL driver, nothing can be rendered. The message names the packages to install.
if said=$(inside 'harness run multi_to_multi --quick' 2>&1); then fail "there is an OpenGL driver already: $said"; fi
echo "$said"
packages=$(echo "$said" | sed -n 's/.*apt-get install \([a-z0-9 -]*\)).*/\1/p' | head -n 1)
[ -n "$packages" ] || fail 'the message names no packages'
timed "apt-get -qq update && apt-get -qq install --no-install-recommends $packages >/dev/null 2>&1"

timed 'harness doctor'
timed 'harness run multi_to_multi --quick'
timed 'harness claims --quick | tail -n 12'
timed 'harness query "select distinct command from runs"'
echo 'wheel trial: passed'
