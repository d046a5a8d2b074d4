#!/bin/sh
# Installs ngspice, which results are compared with, and Chromium, in which the explorer's page is tested, by the system's
# packages where that takes no question: as root, or with a sudo that asks nothing. Without them the tests run all but
# those comparisons, and say so in their last line.
install() {
    if command -v apt-get; then
        $as_root apt-get update -qq
        $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$1"
    elif command -v dnf; then
        $as_root dnf install -y -q "$1"
    elif command -v zypper; then
        $as_root zypper --non-interactive --quiet install "$1"
    elif command -v pacman; then
        $as_root pacman -S --noconfirm --quiet "$1"
    elif command -v apk; then
        $as_root apk add --quiet "$1"
    fi
}

for program in ngspice chromium; do
    command -v "$program" >/dev/null && continue
    if [ "$(id -u)" = 0 ]; then
        as_root=
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        as_root="sudo -n"
    else
        echo "$program is not installed, and installing it takes a password: sudo apt-get install $program"
        continue
    fi
    echo "installing $program, which some tests need ..."
    install "$program" >/dev/null 2>&1 </dev/null
    command -v "$program" >/dev/null || echo "$program could not be installed; what needs it is left out"
done
exit 0
