"""The parts of `scripts/compare_frames.py`: variants, measurements, summary and figures."""
