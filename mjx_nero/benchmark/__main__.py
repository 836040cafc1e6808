"""python -m mjx_nero.benchmark"""

from mjx_nero import benchmark, cli

if __name__ == "__main__":
    cli.run(benchmark.main)
