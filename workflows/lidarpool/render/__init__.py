"""Pictures by our own ray caster: what a camera sees of a scene, and points over it."""
