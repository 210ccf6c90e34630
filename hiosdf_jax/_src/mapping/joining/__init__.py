"""Maps that move, and maps that become one."""
