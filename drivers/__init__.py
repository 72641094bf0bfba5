"""One device each, behind the contracts of `scanner.devices`; `drivers.registry` finds them by name."""
