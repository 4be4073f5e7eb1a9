"""Environments for reinforcement learning around the simulator."""
