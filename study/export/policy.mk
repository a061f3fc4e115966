# `make test` compares policy.c with PyTorch.
CFLAGS = -std=c99 -O2 -Wall -Wextra -Wpedantic -Wconversion -Wno-unused-function -Werror

.PHONY: test clean

test: test_policy
	./test_policy

test_policy: test_policy.c policy.c policy.h
	$(CC) $(CFLAGS) -o $@ test_policy.c policy.c -lm

clean:
	rm -f test_policy
