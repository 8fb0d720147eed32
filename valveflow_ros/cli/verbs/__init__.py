"""One module for each verb: `arguments` adds its options, `run` does it."""
