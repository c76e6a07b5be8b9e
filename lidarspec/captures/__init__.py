"""Captures of network traffic: pcap and pcapng files as datagrams, and back."""
