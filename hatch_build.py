"""Puts the compiled code that `make wheel` has made into the wheel, which is then for this Python and processor."""

import os
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ObjectCode(BuildHookInterface):
    def initialize(self, version, build_data):
        files = [*Path(self.root, os.environ["OBJECTS"]).rglob("*.nbc")] if "OBJECTS" in os.environ else []
        build_data["force_include"].update({str(file): f"fingerspice/objects/{file.name}" for file in files})
        if files:
            build_data.update(pure_python=False, infer_tag=True)
