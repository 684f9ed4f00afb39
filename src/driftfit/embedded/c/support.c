static real real_minimum(real a, real b) { return b < a ? b : a; }

static real real_maximum(real a, real b) { return b > a ? b : a; }

static int64_t whole_minimum(int64_t a, int64_t b) { return b < a ? b : a; }

static int64_t whole_maximum(int64_t a, int64_t b) { return b > a ? b : a; }

static int64_t whole_abs(int64_t a) { return a < 0 ? -a : a; }

static real real_square(real a) { return a * a; }

static double from_bits(int64_t bits) {
    union { int64_t whole; double number; } both;
    both.whole = bits;
    return both.number;
}

static int64_t bits_of(double number) {
    union { int64_t whole; double number; } both;
    both.number = number;
    return both.whole;
}
