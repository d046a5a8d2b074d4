"""`python -m fingerspice` is the `fingerspice` command."""

from fingerspice.cli import main

if __name__ == "__main__":
    main()
