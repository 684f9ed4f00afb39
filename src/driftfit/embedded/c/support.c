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

typedef struct { real at[4]; } four;

static four four_of(real x) { four v = {{x, x, x, x}}; return v; }

static four four_at(const real *x) { four v = {{x[0], x[1], x[2], x[3]}}; return v; }

static four four_plus(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] + b.at[i]; }
    return a;
}

static four four_times(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] * b.at[i]; }
    return a;
}

static int64_t four_reached(four a, four b) {
    int64_t count = 0;
    for (int i = 0; i < 4; i++) { count += a.at[i] >= b.at[i]; }
    return count;
}
