"""Environments for reinforcement learning: PettingZoo, Gymnasium and batches around one core.

Observations, rewards, action spaces and recordings of episodes live here.
Physics never does: an environment only translates between a learner and the simulator.
"""
