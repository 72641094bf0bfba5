"""Compiles the kernels that decoders use, as a worker does when it starts; setup/rig.sh says for which processor."""

import importlib

from service.warm_up import modules_with_kernels

for name in modules_with_kernels():
    if name.startswith("scanner."):
        importlib.import_module(name).warm_up()
