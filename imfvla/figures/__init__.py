"""Figures of the paper, drawn with matplotlib from results and configurations. Needs neither torch nor mujoco."""
