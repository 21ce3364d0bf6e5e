/* Check the proved part of a certificate, on the computer that drives.

       cc -std=c99 -O2 -o check_proof check_proof.c && ./check_proof proof.bin

   The step is z+ = A(e) z + W_L s(... s(W_1 z + b_1) ...) + b, where s has slopes in
   [0, 1] and A(e) is in the hull of the vertices. Of each output C z it is checked that

       |z+ - z'+|_P <= alpha |z - z'|_P,   alpha < 1,   |C z| <= L |z|_P,   P of size 1.

   As in the trusted core, sfkd_jax/certification/_core.py, rounding is bounded, and what
   is in doubt is refused. Nothing is allocated; libm is not needed. The exit status is 0
   if every file is accepted. A program that has the bytes of proof.bin in memory defines
   NO_MAIN and calls check_proof. To save memory define all five MAX_. */
#include <float.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#if defined __FAST_MATH__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math: a NaN must be refused, and rounding be bounded"
#endif
#if DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024 || FLT_EVAL_METHOD != 0
#error "double must be IEEE binary64, computed without excess precision"
#endif

#ifndef MAX_RANK
#define MAX_RANK 64       /* entries of z, and rows of an output */
#define MAX_HIDDEN 448    /* widths of all hidden layers together */
#define MAX_LAYERS 8      /* matrices of the residual */
#define MAX_OUTPUTS 16
#define MAX_BYTES 4194304 /* of a file */
#endif
#define MAX_SIZE (MAX_RANK + MAX_HIDDEN)
#define MAGIC "SFKDPRF" /* 8 bytes with the 0 at its end */
#define VERSION 1
#define HASH 32 /* bytes of a SHA-256 */
#define UNIT (DBL_EPSILON / 2.0)
#define MARGIN 1e-6     /* far above the rounding of sums of squares */
#define UNIT_ERROR 1e-9 /* of the size of P, which is 1 by convention */

/* Numbers stay where they are, which may be in flash. */
typedef const unsigned char *bytes;
typedef struct { bytes at; size_t left; } reader;
typedef struct {
    bytes name, metric, rows, multipliers;
    uint32_t letters, row_count;
    double alpha, lipschitz, trace; /* trace of P, at least its norm */
} output;
typedef struct {
    uint32_t rank, vertices, layers, outputs, hidden, width[MAX_LAYERS + 1];
    bytes hash, vertex, weight[MAX_LAYERS];
    output claim[MAX_OUTPUTS];
} proof;

/* The upper triangle and the diagonal hold M until a factor replaces the rest. */
static double matrix[MAX_SIZE][MAX_SIZE];
static double left[MAX_RANK][MAX_SIZE], right[MAX_RANK][MAX_SIZE];

/* Whether all symmetric matrices within `error` of M, in the 2-norm, are positive
   definite: they are if M = U U' / D + c I + R with D > 0 and ||R|| + error < c. U is of
   Gaussian elimination, without roots, and D is its diagonal. U need not be exact: R is
   computed from it. The norm of the products is at most trace U U' / D, which bounds
   their rounding. A NaN or an infinity of M is one of R, and is refused. */
static int is_positive_definite(uint32_t size, double error) {
    static double weighted[MAX_SIZE];
    double trace = 0.0, scale = 1.0, residual = 0.0, factor = 0.0;
    double shift, entry, moved, squared, rest, room;
    uint32_t i, j, k;
    for (i = 0; i < size; i++) trace += matrix[i][i];
    if (!(trace > 1e-300 && trace < 1e300)) return 0;
    /* A power of two; underflow is then far below MARGIN times the shift c. */
    for (; trace * scale >= 1.0; scale *= 0.5) { }
    for (; trace * scale < 0.5; scale *= 2.0) { }
    error *= scale;
    shift = 4.0 * (size + 2.0) * UNIT * trace * scale + error * (1.0 + 4.0 * MARGIN);
    for (i = 0; i < size; i++)
        for (j = 0; j <= i; j++) {
            entry = scale * matrix[j][i];
            moved = i == j ? shift : 0.0;
            squared = 0.0;
            for (k = 0; k < j; k++)
                squared += weighted[k] * matrix[j][k];
            rest = entry - squared - moved;
            if (i == j && !(rest > 0.0)) return 0;
            matrix[i][j] = rest;
            weighted[j] = rest / matrix[j][j];
            squared += weighted[j] * matrix[j][j];
            rest = entry - squared - moved;
            residual += (i == j ? 1.0 : 2.0) * rest * rest;
            factor += i == j ? squared : 0.0;
        }
    room = shift * (1.0 - MARGIN) - error;
    room -= (size + 3.0) * UNIT * factor * (1.0 + MARGIN);
    return room > MARGIN * shift && residual * (1.0 + 4.0 * MARGIN) < room * room;
}

/* Return where `count` parts of `width` bytes begin; NULL from then on if none do. */
static bytes take(reader *from, size_t count, size_t width) {
    bytes at = from->at;
    if (at == NULL || (width > 0 && count > from->left / width)) return from->at = NULL;
    from->at += count * width;
    from->left -= count * width;
    return at;
}

/* Little-endian on every processor; 0 of nothing. */
static uint64_t integer(bytes at, int width) {
    uint64_t bits = 0;
    while (at != NULL && width > 0)
        bits = bits << 8 | at[--width];
    return bits;
}

static uint32_t count(reader *from) { return (uint32_t)integer(take(from, 1, 4), 4); }

static double number(bytes at, size_t index) {
    uint64_t bits = integer(at == NULL ? at : at + 8 * index, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Find the parts of a document; return what is wrong with its sizes, or NULL. */
static const char *read_proof(proof *into, bytes document, size_t length) {
    static const char *too_large = "a size is 0, or larger than its MAX_ macro";
    reader from = {document, length};
    bytes magic = take(&from, sizeof MAGIC, 1);
    uint32_t k;
    if (magic == NULL || memcmp(magic, MAGIC, sizeof MAGIC) || count(&from) != VERSION)
        return "there is no proof of this version in it";
    into->rank = count(&from);
    into->vertices = count(&from);
    into->layers = count(&from);
    into->outputs = count(&from);
    into->hidden = 0;
    if (into->rank - 1 >= MAX_RANK || into->vertices == 0 || into->layers > MAX_LAYERS
        || into->outputs - 1 >= MAX_OUTPUTS) /* 0 - 1 is the largest number */
        return too_large;
    into->width[0] = into->width[into->layers] = into->rank;
    for (k = 1; k < into->layers; k++) {
        into->width[k] = count(&from);
        if (into->width[k] - 1 >= MAX_HIDDEN - into->hidden) return too_large;
        into->hidden += into->width[k];
    }
    into->hash = take(&from, HASH, 1);
    into->vertex = take(&from, into->vertices, (size_t)8 * into->rank * into->rank);
    for (k = 0; k < into->layers; k++)
        into->weight[k] = take(&from, into->width[k + 1], (size_t)8 * into->width[k]);
    for (k = 0; k < into->outputs; k++) {
        output *claim = &into->claim[k];
        claim->letters = count(&from);
        claim->row_count = count(&from);
        if (from.at != NULL && claim->row_count - 1 >= MAX_RANK) return too_large;
        claim->name = take(&from, claim->letters, 1);
        claim->alpha = number(take(&from, 1, 8), 0);
        claim->lipschitz = number(take(&from, 1, 8), 0);
        claim->metric = take(&from, into->rank, (size_t)8 * into->rank);
        claim->rows = take(&from, claim->row_count, (size_t)8 * into->rank);
        claim->multipliers = take(&from, into->vertices, (size_t)8 * into->hidden);
    }
    return from.at == NULL || from.left > 0 ? "its length is another one" : NULL;
}

/* Whether |f(z) - f(z')| <= b |z - z'|_P, where f is the step at a vertex, in the norm
   of P, or else, without multipliers, C z in the 2-norm. M is that of `check_witness`:
   b^2 P and the couplings of the layers, less X' Y = [A .. W]' P [A .. W]. */
static int is_bounded(const proof *about, const output *claim, bytes linear,
                      bytes multipliers, double bound) {
    int is_step = multipliers != NULL;
    uint32_t layers = is_step ? about->layers : 0;
    uint32_t rows = is_step ? about->rank : claim->row_count;
    uint32_t rank = about->rank, size = rank + (is_step ? about->hidden : 0);
    uint32_t width = rank, block = 0, next, i, j, k;
    double squares = 0.0, trace = 0.0, entry, error;
    memset(matrix, 0, size * sizeof matrix[0]);
    memset(left, 0, rows * sizeof left[0]);
    for (i = 0; i < rank; i++)
        for (j = 0; j < rank; j++)
            matrix[i][j] = bound * bound * number(claim->metric, i * rank + j);
    for (k = 0; k + 1 < layers; k++) {
        next = block + width;
        for (i = 0; i < about->width[k + 1]; i++) {
            entry = number(multipliers, next - rank + i);
            if (!(entry > 0.0)) return 0;
            matrix[next + i][next + i] = 2.0 * entry;
            for (j = 0; j < width; j++)
                matrix[block + j][next + i] =
                    -entry * number(about->weight[k], i * width + j);
        }
        block = next;
        width = about->width[k + 1];
    }
    for (i = 0; i < rows; i++) {
        for (j = 0; j < width && layers > 0; j++)
            left[i][block + j] = number(about->weight[layers - 1], i * width + j);
        for (j = 0; j < rank; j++)
            left[i][j] += number(linear, i * rank + j);
    }
    for (i = 0; i < rows; i++)
        for (j = 0; j < size; j++) {
            right[i][j] = is_step ? 0.0 : left[i][j];
            for (k = 0; k < rank && is_step; k++)
                right[i][j] += number(claim->metric, i * rank + k) * left[k][j];
            squares += left[i][j] * left[i][j];
        }
    for (i = 0; i < size; i++) {
        for (j = i; j < size; j++) {
            entry = 0.0;
            for (k = 0; k < rows; k++)
                entry += left[k][i] * right[k][j];
            matrix[i][j] -= entry;
        }
        trace += matrix[i][i];
    }
    /* Rounding: of X, Y and X' Y; of b^2 P; of the difference and the couplings, of norms
       at most trace M, and trace M + ||X' Y||, if M is positive definite. */
    error = (rank + rows + 4.0) * (is_step ? claim->trace : 1.0) * squares;
    error = 4.0 * UNIT * (error + bound * bound * claim->trace + trace) + 1e-300;
    return is_positive_definite(size, error);
}

/* Return why the claim about an output does not follow, or NULL. */
static const char *refusal(const proof *about, output *claim) {
    double largest = 0.0, size_error;
    uint32_t rank = about->rank, i, j;
    size_t k;
    claim->trace = 0.0;
    for (i = 0; i < rank; i++) {
        for (j = 0; j < rank; j++) {
            matrix[i][j] = number(claim->metric, i * rank + j);
            if (matrix[i][j] != number(claim->metric, j * rank + i))
                return "P is not symmetric";
        }
        claim->trace += matrix[i][i];
        largest = matrix[i][i] > largest ? matrix[i][i] : largest;
    }
    /* The largest entry of a positive definite matrix is on its diagonal. */
    size_error = 0.5 * (claim->trace / rank + largest) - 1.0;
    if (!(size_error <= UNIT_ERROR && -size_error <= UNIT_ERROR))
        return "P is not of size 1";
    if (!is_positive_definite(rank, 0.0)) return "P is not positive definite";
    if (!(claim->alpha > 0.0 && claim->alpha < 1.0))
        return "alpha is not between 0 and 1";
    for (k = 0; k < about->vertices; k++)
        if (!is_bounded(about, claim, about->vertex + 8 * k * rank * rank,
                        claim->multipliers + 8 * k * about->hidden, claim->alpha))
            return "alpha does not follow from its witness";
    return claim->lipschitz > 0.0
        && is_bounded(about, claim, claim->rows, NULL, claim->lipschitz)
        ? NULL : "L does not follow from P";
}

/* In ASCII: the text of a document moves no cursor. */
static void print(const char *before, const output *claim) {
    printf("%s: ", before);
    for (uint32_t k = 0; k < claim->letters; k++)
        putchar(claim->name[k] < ' ' || claim->name[k] > '~' ? '?' : claim->name[k]);
}

/* Print alpha and L of every output, or why it is refused; return if it is accepted. */
int check_proof(const char *label, const unsigned char *document, size_t length) {
    static proof about;
    volatile double one = 1.0, least = DBL_MIN;
    volatile double denormal = least * DBL_EPSILON;
    const char *reason = "this processor flushes denormal numbers, or rounds otherwise";
    const output *claim;
    uint32_t k;
    if (denormal > 0.0 && one + UNIT == one && one + 1.5 * UNIT > one)
        reason = read_proof(&about, document, length);
    for (k = 0; reason == NULL && k < about.outputs; k++)
        reason = refusal(&about, &about.claim[k]);
    if (reason != NULL) {
        printf("%s: refused: %s", label, reason);
        if (k > 0) print(", output", &about.claim[k - 1]);
        printf("\n");
        return 0;
    }
    printf("%s: proved about the weights ", label);
    for (k = 0; k < HASH; k++) printf("%02x", about.hash[k]);
    for (claim = about.claim; claim < about.claim + about.outputs; claim++) {
        printf("\n");
        print(label, claim);
        printf(": alpha %.17g, L %.17g", claim->alpha, claim->lipschitz);
    }
    printf("\n");
    return 1;
}

#ifndef NO_MAIN
int main(int files, char **names) {
    static unsigned char document[MAX_BYTES];
    int accepted = files > 1, k;
    for (k = 1; k < files; k++) {
        FILE *file = fopen(names[k], "rb");
        size_t length = file == NULL ? 0 : fread(document, 1, sizeof document, file);
        accepted &= check_proof(names[k], document, length);
        if (file != NULL) fclose(file);
    }
    return !accepted;
}
#endif
