"""Robots as their files describe them: links, joints, meshes, poses."""
