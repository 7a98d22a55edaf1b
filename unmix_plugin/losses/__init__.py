"""What a training asks for, and how it is compared with what was measured."""
