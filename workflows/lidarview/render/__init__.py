"""Pictures by our own ray caster: scenes seen by a camera, and points over them."""
