"""Exchange files that list the rays of sensors or describe their scan patterns."""
