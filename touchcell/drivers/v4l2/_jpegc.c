/* Whether a baseline JPEG is complete and undamaged, as far as a decoder could notice: the Huffman code of its scan is
 * read to the end, without computing any pixel. ITU-T T.81: annex B (markers), annex F (decoding), annex K (the tables
 * that Motion JPEG leaves out). */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <string.h>

enum {
    GOOD = 0,
    NO_START,
    NO_MARKER,
    SHORT_SEGMENT,
    NO_SCAN,
    BAD_TABLE,
    BAD_FRAME,
    BAD_CODE,
    TRUNCATED,
    BAD_RESTART,
    TRAILING,
    OTHER_PROCESS,
};

typedef struct {
    int valid;
    int32_t largest[17]; /* largest code of each length, -1 where there is none */
    int32_t first[17];   /* first code of each length */
    int offset[17];      /* index of that code's symbol */
    uint8_t symbols[256];
} Table;

typedef struct {
    const uint8_t *at, *end;
    uint32_t bits;
    int count;
    int missing; /* bits asked for beyond the end of the segment */
} Reader;

typedef struct {
    int id, h, v, dc, ac;
} Component;

static const uint8_t DC_LUMA[] = {0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11};
static const uint8_t DC_CHROMA[] = {0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0,
                                    0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11};
static const uint8_t AC_LUMA[] = {
    0,    2,    1,    3,    3,    2,    4,    3,    5,    5,    4,    4,    0,    0,    1,    125,  0x01, 0x02, 0x03,
    0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91,
    0xA1, 0x08, 0x23, 0x42, 0xB1, 0xC1, 0x15, 0x52, 0xD1, 0xF0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0A, 0x16, 0x17,
    0x18, 0x19, 0x1A, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2A, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x43, 0x44, 0x45,
    0x46, 0x47, 0x48, 0x49, 0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5A, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68,
    0x69, 0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8A, 0x92,
    0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A, 0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7, 0xA8, 0xA9, 0xAA, 0xB2, 0xB3,
    0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA, 0xC2, 0xC3, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2, 0xD3, 0xD4,
    0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA, 0xE1, 0xE2, 0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF1, 0xF2, 0xF3,
    0xF4, 0xF5, 0xF6, 0xF7, 0xF8, 0xF9, 0xFA};
static const uint8_t AC_CHROMA[] = {
    0,    2,    1,    2,    4,    4,    3,    4,    7,    5,    4,    4,    0,    1,    2,    119,  0x00, 0x01, 0x02,
    0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14,
    0x42, 0x91, 0xA1, 0xB1, 0xC1, 0x09, 0x23, 0x33, 0x52, 0xF0, 0x15, 0x62, 0x72, 0xD1, 0x0A, 0x16, 0x24, 0x34, 0xE1,
    0x25, 0xF1, 0x17, 0x18, 0x19, 0x1A, 0x26, 0x27, 0x28, 0x29, 0x2A, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x43, 0x44,
    0x45, 0x46, 0x47, 0x48, 0x49, 0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5A, 0x63, 0x64, 0x65, 0x66, 0x67,
    0x68, 0x69, 0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89,
    0x8A, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A, 0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7, 0xA8, 0xA9, 0xAA,
    0xB2, 0xB3, 0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA, 0xC2, 0xC3, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2,
    0xD3, 0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA, 0xE2, 0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF2, 0xF3,
    0xF4, 0xF5, 0xF6, 0xF7, 0xF8, 0xF9, 0xFA};

/* Builds a table from 16 counts and their symbols; returns the bytes read, 0 for a table that cannot be. */
static int build(Table *table, const uint8_t *data, Py_ssize_t left) {
    if (left < 16) return 0;
    int total = 0;
    int32_t code = 0;
    for (int length = 1; length <= 16; length++) {
        int n = data[length - 1];
        table->first[length] = code;
        table->offset[length] = total;
        table->largest[length] = n ? code + n - 1 : -1;
        code += n;
        total += n;
        if (code > 1 << length) return 0;
        code <<= 1;
    }
    if (total > 256 || left < 16 + total) return 0;
    memcpy(table->symbols, data + 16, total);
    table->valid = 1;
    return 16 + total;
}

static int next_bit(Reader *reader) {
    if (!reader->count) {
        if (reader->at >= reader->end || (reader->at[0] == 0xFF && (reader->at + 1 >= reader->end || reader->at[1]))) {
            reader->missing++;
            return 0;
        }
        reader->bits = *reader->at;
        reader->at += reader->at[0] == 0xFF ? 2 : 1;
        reader->count = 8;
    }
    return reader->bits >> --reader->count & 1;
}

static void skip(Reader *reader, int bits) {
    while (bits-- > 0) next_bit(reader);
}

/* Next symbol, -1 for a code that the table does not have. */
static int symbol(Reader *reader, const Table *table) {
    int32_t code = 0;
    for (int length = 1; length <= 16; length++) {
        code = code << 1 | next_bit(reader);
        if (code <= table->largest[length]) return table->symbols[table->offset[length] + code - table->first[length]];
    }
    return -1;
}

static int block(Reader *reader, const Table *dc, const Table *ac) {
    int size = symbol(reader, dc);
    if (size < 0 || size > 15) return BAD_CODE;
    skip(reader, size);
    for (int k = 1; k < 64;) {
        int run_size = symbol(reader, ac);
        if (run_size < 0) return BAD_CODE;
        int run = run_size >> 4;
        size = run_size & 15;
        if (!size && run < 15) break;
        k += run + 1;
        if (k > 64) return BAD_CODE;
        skip(reader, size);
    }
    return reader->missing ? TRUNCATED : GOOD;
}

static int restart(Reader *reader, int number) {
    reader->count = 0;
    while (reader->at + 1 < reader->end && reader->at[0] == 0xFF && reader->at[1] == 0xFF) reader->at++;
    if (reader->at + 1 >= reader->end) return TRUNCATED;
    if (reader->at[0] != 0xFF || reader->at[1] != 0xD0 + (number & 7)) return BAD_RESTART;
    reader->at += 2;
    return GOOD;
}

static int scan(Reader *reader, const Component *components, int n, const Table tables[2][4], long mcus, int interval) {
    for (long mcu = 0; mcu < mcus; mcu++) {
        if (interval && mcu && mcu % interval == 0) {
            int problem = restart(reader, (int)(mcu / interval - 1));
            if (problem) return problem;
        }
        for (int c = 0; c < n; c++) {
            for (int b = n == 1 ? 1 : components[c].h * components[c].v; b > 0; b--) {
                int problem = block(reader, &tables[0][components[c].dc], &tables[1][components[c].ac]);
                if (problem) return problem;
            }
        }
    }
    /* Cameras pad before and after the end marker. Any other byte in front of it belongs to a damaged scan. */
    while (reader->at < reader->end) {
        if (reader->at[0] == 0xFF && reader->at + 1 < reader->end && reader->at[1] >= 0xC0 && reader->at[1] != 0xFF)
            return reader->at[1] == 0xD9 ? GOOD : TRAILING;
        if (reader->at[0] != 0xFF && reader->at[0] != 0x00) return TRAILING;
        reader->at++;
    }
    return GOOD;
}

static int check(const uint8_t *data, Py_ssize_t size, int *width, int *height) {
    static const uint8_t *defaults[2][2] = {{DC_LUMA, DC_CHROMA}, {AC_LUMA, AC_CHROMA}};
    static const Py_ssize_t sizes[2][2] = {{sizeof DC_LUMA, sizeof DC_CHROMA}, {sizeof AC_LUMA, sizeof AC_CHROMA}};
    Table tables[2][4];
    Component components[4], chosen[4];
    int n = 0, interval = 0, h_max = 1, v_max = 1;
    memset(tables, 0, sizeof tables);
    for (int kind = 0; kind < 2; kind++)
        for (int i = 0; i < 2; i++) build(&tables[kind][i], defaults[kind][i], sizes[kind][i]);
    *width = *height = 0;
    if (size < 2 || data[0] != 0xFF || data[1] != 0xD8) return NO_START;
    Py_ssize_t at = 2;
    while (at + 4 <= size) {
        if (data[at] != 0xFF) return NO_MARKER;
        int marker = data[at + 1];
        if (marker == 0xFF) {
            at++;
            continue;
        }
        if (marker == 0x01 || (marker >= 0xD0 && marker <= 0xD7)) {
            at += 2;
            continue;
        }
        if (marker == 0xD9) return NO_SCAN;
        Py_ssize_t length = data[at + 2] << 8 | data[at + 3];
        if (length < 2 || at + 2 + length > size) return SHORT_SEGMENT;
        const uint8_t *segment = data + at + 4;
        Py_ssize_t left = length - 2;
        if (marker == 0xC4) {
            while (left > 0) {
                int kind = segment[0] >> 4, number = segment[0] & 15;
                if (kind > 1 || number > 3) return BAD_TABLE;
                int used = build(&tables[kind][number], segment + 1, left - 1);
                if (!used) return BAD_TABLE;
                segment += 1 + used;
                left -= 1 + used;
            }
        } else if (marker == 0xDD) {
            if (left < 2) return SHORT_SEGMENT;
            interval = segment[0] << 8 | segment[1];
        } else if (marker >= 0xC0 && marker <= 0xCF && marker != 0xC8 && marker != 0xCC) {
            if (left < 6) return BAD_FRAME;
            *height = segment[1] << 8 | segment[2];
            *width = segment[3] << 8 | segment[4];
            n = segment[5];
            if (marker > 0xC1 || segment[0] != 8 || !*height) return OTHER_PROCESS;
            if (!*width || n < 1 || n > 4 || left < 6 + 3 * n) return BAD_FRAME;
            for (int c = 0; c < n; c++) {
                components[c].id = segment[6 + 3 * c];
                components[c].h = segment[7 + 3 * c] >> 4;
                components[c].v = segment[7 + 3 * c] & 15;
                if (components[c].h < 1 || components[c].h > 4 || components[c].v < 1 || components[c].v > 4)
                    return BAD_FRAME;
                if (components[c].h > h_max) h_max = components[c].h;
                if (components[c].v > v_max) v_max = components[c].v;
            }
        } else if (marker == 0xDA) {
            if (!n || left < 1) return NO_SCAN;
            if (segment[0] != n) return OTHER_PROCESS;
            if (left < 1 + 2 * n + 3) return SHORT_SEGMENT;
            for (int s = 0; s < n; s++) {
                int found = -1;
                for (int c = 0; c < n; c++)
                    if (components[c].id == segment[1 + 2 * s]) found = c;
                if (found < 0) return BAD_FRAME;
                chosen[s] = components[found];
                chosen[s].dc = segment[2 + 2 * s] >> 4;
                chosen[s].ac = segment[2 + 2 * s] & 15;
                if (chosen[s].dc > 3 || chosen[s].ac > 3 || !tables[0][chosen[s].dc].valid ||
                    !tables[1][chosen[s].ac].valid)
                    return BAD_TABLE;
            }
            long across = n == 1 ? (*width + 7) / 8 : (*width + 8 * h_max - 1) / (8 * h_max);
            long down = n == 1 ? (*height + 7) / 8 : (*height + 8 * v_max - 1) / (8 * v_max);
            Reader reader = {segment + left, data + size, 0, 0, 0};
            return scan(&reader, chosen, n, tables, across * down, interval);
        }
        at += 2 + length;
    }
    return NO_SCAN;
}

static PyObject *check_py(PyObject *module, PyObject *argument) {
    (void)module;
    Py_buffer view;
    if (PyObject_GetBuffer(argument, &view, PyBUF_SIMPLE)) return NULL;
    int width, height, problem;
    Py_BEGIN_ALLOW_THREADS
    problem = check(view.buf, view.len, &width, &height);
    Py_END_ALLOW_THREADS
    PyBuffer_Release(&view);
    return Py_BuildValue("iii", problem, width, height);
}

static PyMethodDef METHODS[] = {
    {"check", check_py, METH_O, "Return (problem, width, height) of a JPEG; problem 0: complete and undamaged."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_jpegc", NULL, 0, METHODS, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__jpegc(void) { return PyModule_Create(&MODULE); }
