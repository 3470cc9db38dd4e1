"""What runs a network: clocks, memory, devices, precisions, processors, and the record of them."""
