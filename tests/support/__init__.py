"""Scenes and problems that several tests share."""
