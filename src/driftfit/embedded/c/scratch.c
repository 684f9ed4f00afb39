/* What steps work in: it carries nothing from one sample to the next. */
typedef struct {
@fields@
} scratch_fields;
