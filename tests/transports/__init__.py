"""Bytes from and to ports, sockets and files."""
