"""Process-level utilities: result files, strict JSON, locks, console output, memory allocator."""
