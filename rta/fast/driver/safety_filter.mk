# `make test` compares safety_filter.c with Python's answers, `make run` flies the example, `make stack` says how much
# stack each function takes.
CFLAGS = -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Wpedantic -Wconversion -Werror

.PHONY: test run stack clean

test: test_safety_filter
	@sha256sum --check --status safety_filter.sha256 || echo "NOT VERIFIED: safety_filter.c or .h was changed"
	./test_safety_filter

run: example
	./example

stack: safety_filter.o
	@sort -t "$$(printf '\t')" -k 2,2 -n -r safety_filter.su | head -n 20

test_safety_filter: test_safety_filter.c safety_filter_vectors.h safety_filter.o safety_filter.h
	$(CC) $(CFLAGS) -o $@ test_safety_filter.c safety_filter.o -lm

example: example.c safety_filter.o safety_filter.h
	$(CC) $(CFLAGS) -o $@ example.c safety_filter.o -lm

safety_filter.o: safety_filter.c safety_filter.h
	$(CC) $(CFLAGS) -fstack-usage -c -o $@ safety_filter.c

clean:
	rm -f test_safety_filter example safety_filter.o safety_filter.su
