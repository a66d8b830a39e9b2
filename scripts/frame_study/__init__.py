"""The pieces of `scripts/compare_frames.py`: what is compared, how it is measured, kept and summarised."""
