"""The Python interface: what `import ema_pipeline` offers. Each call runs the stages that the commands run."""
