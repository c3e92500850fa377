"""The pure core: numpy in, numpy out. It knows no sockets, clocks, files, threads, logs or configuration."""
