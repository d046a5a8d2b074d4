#!/bin/sh
# Installs ngspice by the system's packages where that takes no question: as root, or with a sudo that asks nothing.
# Without it the tests run all but the comparisons with it, and say so in their last line.
command -v ngspice >/dev/null && exit 0
if [ "$(id -u)" = 0 ]; then
    as_root=
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    echo "ngspice is not installed, and installing it takes a password: sudo apt-get install ngspice"
    exit 0
fi
echo "installing ngspice, which the results are compared with ..."
{
    if command -v apt-get; then
        $as_root apt-get update -qq
        $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq ngspice
    elif command -v dnf; then
        $as_root dnf install -y -q ngspice
    elif command -v zypper; then
        $as_root zypper --non-interactive --quiet install ngspice
    elif command -v pacman; then
        $as_root pacman -S --noconfirm --quiet ngspice
    elif command -v apk; then
        $as_root apk add --quiet ngspice
    fi
} >/dev/null 2>&1 </dev/null
command -v ngspice >/dev/null || echo "ngspice could not be installed; the comparisons with it are left out"
