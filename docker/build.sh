#!/bin/sh
# Builds an image with buildah on a base made by debootstrap, without Docker or a registry, and runs
# its health check as its user on a read-only root.
#   docker/build.sh [cpu|gpu] [-- options of `buildah bud`]
# Run it as root; it needs buildah and debootstrap. MIRROR is a mirror of Debian, SUITE its release. Mount
# files that pip and apt need (an index, certificates) after `--` with `--volume HOST:PLACE:ro`; the image
# keeps an empty file of each. Values of `--env` stay in the image.
set -eu
kind=${1:-cpu}
[ $# -gt 0 ] && shift
[ "${1:-}" = "--" ] && shift
cd "$(dirname "$0")/.."
suite=${SUITE:-bookworm}
base=localhost/real2sim-base:$suite
work=$(mktemp -d)
container=""
cleanup() {
    for place in tmp var/lib/real2sim scenes proc dev ""; do
        umount -l "$work/root/$place" 2>/dev/null || true
    done
    [ -z "$container" ] || buildah rm "$container" >/dev/null
    rm -rf --one-file-system "$work"
}
trap cleanup EXIT

if ! buildah inspect "$base" >/dev/null 2>&1; then
    debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates,libgomp1 \
        "$suite" "$work/base" ${MIRROR:+"$MIRROR"} >"$work/debootstrap.log" \
        || { tail -20 "$work/debootstrap.log" >&2; exit 1; }
    rm -rf "$work/base/var/cache/apt/archives" "$work/base/var/lib/apt/lists"
    scratch=$(buildah from scratch)
    buildah add --quiet "$scratch" "$work/base" / >/dev/null
    buildah commit --quiet --rm "$scratch" "$base" >/dev/null
    rm -rf "$work/base"
fi

before=$(buildah images --quiet "localhost/real2sim:$kind" 2>/dev/null || true)
buildah bud --format docker --isolation chroot --layers=false --build-arg BASE_IMAGE="$base" \
    -f "docker/Dockerfile.$kind" -t "real2sim:$kind" "$@" .
[ -z "$before" ] || buildah rmi "$before" >/dev/null || true

# The health check, as the image's user on a read-only root.
container=$(buildah from "real2sim:$kind")
user=$(buildah inspect --format '{{.OCIv1.Config.User}}' "real2sim:$kind")
case $user in ""|root|0|0:*) echo "the image runs as root" >&2; exit 1 ;; esac
mkdir "$work/root"
mount --bind "$(buildah mount "$container")" "$work/root"
mount -o remount,bind,ro "$work/root"
mount -t proc proc "$work/root/proc"
# As a slave: unmounting it leaves the host's own /dev as it is.
mount --rbind --make-rslave /dev "$work/root/dev"
for place in tmp var/lib/real2sim scenes; do
    mount -t tmpfs -o mode=1777 tmpfs "$work/root/$place"
done
port=$(chroot "$work/root" /usr/bin/python3 -c \
    "import socket; s = socket.socket(); s.bind(('127.0.0.1', 0)); print(s.getsockname()[1])")
setting() { buildah inspect --format '{{range .OCIv1.Config.Env}}{{println .}}{{end}}' "real2sim:$kind"; }
cat >"$work/check" <<CHECK
cd / && exec env -i $(setting | tr '\n' ' ') HOME=/tmp REAL2SIM_HOST=127.0.0.1 REAL2SIM_PORT=$port \
  real2sim serve
CHECK
chroot --userspec="$user" "$work/root" /bin/sh -c "$(cat "$work/check")" &
worker=$!
ready=""
for _ in $(seq 1 120); do
    kill -0 $worker 2>/dev/null || break
    if chroot --userspec="$user" "$work/root" /usr/bin/python3 -c \
        "import urllib.request as u; u.urlopen('http://127.0.0.1:$port/readyz')" 2>/dev/null; then
        ready=yes
        break
    fi
    sleep 1
done
touch "$work/root/written" 2>/dev/null && { echo "the root can be written to" >&2; ready=""; }
kill $worker 2>/dev/null || true
wait $worker || true
[ -n "$ready" ] || { echo "real2sim:$kind does not become ready" >&2; exit 1; }
size=$(buildah images --format '{{.Size}}' "real2sim:$kind" | head -1)
echo "real2sim:$kind is ready as user $user on a read-only root; $size"
