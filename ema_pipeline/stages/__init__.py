"""The stages of the pipeline, one module each: what it needs, its fingerprint, its work."""
