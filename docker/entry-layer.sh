#!/bin/sh
# System packages and the unprivileged account of a worker image.
set -eu
export DEBIAN_FRONTEND=noninteractive
missing=""
ldconfig -p | grep -q libgomp.so.1 || missing="$missing libgomp1"
[ -e /etc/ssl/certs/ca-certificates.crt ] || missing="$missing ca-certificates"
if [ -n "$missing" ]; then
    apt-get update -qq
    # shellcheck disable=SC2086 -- a list of package names
    apt-get install -y -qq --no-install-recommends $missing
    rm -rf /var/lib/apt/lists/*
fi
groupadd --gid 10001 real2sim 2>/dev/null || true
useradd --uid 10001 --gid 10001 --no-log-init --create-home --home-dir /var/lib/real2sim real2sim \
    2>/dev/null || true
mkdir -p /var/lib/real2sim /var/cache/real2sim/numba /scenes
chown -R real2sim:real2sim /var/lib/real2sim /var/cache/real2sim /scenes
