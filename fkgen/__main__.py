"""``python -m fkgen`` is the command ``fkgen``."""

from fkgen.cli import main

main(prog_name="fkgen")
