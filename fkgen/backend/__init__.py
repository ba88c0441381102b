"""From a proved recursion to C: IR, lowering, printing, rendering."""
