"""Command lines: collect, pretrain, adapt, plot, bench."""
