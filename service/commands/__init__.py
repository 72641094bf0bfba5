"""The commands of `fringed`, one subject a module. Each returns its exit status and raises ScannerError."""
