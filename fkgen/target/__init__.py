"""The filter on the processors it is made for: emulated boards, firmware, packages."""
