"""The mock rig: one bench with a scene, a projector, a camera, a stage and lights."""
