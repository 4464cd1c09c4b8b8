"""Salient events: how they are proposed, filtered and chosen as targets."""
