/*
 * The tree of all AABBs: moves the AABB of a link that has moved.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * move_aabb        btDbvtBroadphase::setAabb
 * move_leaf        btDbvt::update, which calls removeleaf and insertleaf
 * find_overlaps    btDbvt::collideTTpersistentStack
 *
 * Why the results are the same
 * ----------------------------
 * The shape of the tree decides in which order Bullet finds new pairs of overlapping
 * AABBs, and this order decides the results of later steps. move_leaf therefore makes
 * the same tree as Bullet.
 *
 * A moved AABB nearly always overlaps the same AABBs as before, and Bullet only counts
 * pairs that it knows already. The code is faster because find_overlaps compares the
 * AABB with a packed list of all AABBs instead of walking through the tree, and because
 * read_aabbs looks up the known pairs only once per step. If a pair is new, Bullet's
 * function does everything, so new pairs are appended in Bullet's order.
 *
 * Bullet enlarges AABBs in the tree by a margin and by a predicted motion. Both are 0 in
 * pybullet. The sign of a zero may therefore differ from Bullet's. If a limit is NaN, or
 * if the moved AABB does not overlap the old one, Bullet's function moves it.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "solver.h"

#include <emmintrin.h>
#include <math.h>

/* The limits of an AABB as loaded into registers. */
struct limits {
    __m128d min_xy, min_z, max_xy, max_z; /* the upper number of min_z, max_z is unused */
};

static inline struct limits load(const struct aabb *aabb) {
    return (struct limits){_mm_loadu_pd(&aabb->min.x), _mm_loadu_pd(&aabb->min.z),
                           _mm_loadu_pd(&aabb->max.x), _mm_loadu_pd(&aabb->max.z)};
}

static inline void save(struct aabb *aabb, struct limits a) {
    _mm_storeu_pd(&aabb->min.x, a.min_xy);
    _mm_storeu_pd(&aabb->min.z, a.min_z);
    _mm_storeu_pd(&aabb->max.x, a.max_xy);
    _mm_storeu_pd(&aabb->max.z, a.max_z);
}

/* Whether both numbers of xy and the lower number of z are true. */
static inline int all(__m128d xy, __m128d z) {
    return _mm_movemask_pd(_mm_and_pd(xy, _mm_unpacklo_pd(z, z))) == 3;
}

static inline int overlap(struct limits a, struct limits b) {
    return all(_mm_and_pd(_mm_cmple_pd(a.min_xy, b.max_xy),
                          _mm_cmpge_pd(a.max_xy, b.min_xy)),
               _mm_and_pd(_mm_cmple_sd(a.min_z, b.max_z),
                          _mm_cmpge_sd(a.max_z, b.min_z)));
}

static inline int contains(struct limits a, struct limits b) {
    return all(_mm_and_pd(_mm_cmple_pd(a.min_xy, b.min_xy),
                          _mm_cmpge_pd(a.max_xy, b.max_xy)),
               _mm_and_pd(_mm_cmple_sd(a.min_z, b.min_z),
                          _mm_cmpge_sd(a.max_z, b.max_z)));
}

static inline int is_same(struct limits a, struct limits b) {
    return all(_mm_and_pd(_mm_cmpeq_pd(a.min_xy, b.min_xy),
                          _mm_cmpeq_pd(a.max_xy, b.max_xy)),
               _mm_and_pd(_mm_cmpeq_sd(a.min_z, b.min_z),
                          _mm_cmpeq_sd(a.max_z, b.max_z)));
}

static inline struct limits merge(struct limits a, struct limits b) {
    return (struct limits){
        _mm_min_pd(a.min_xy, b.min_xy), _mm_min_pd(a.min_z, b.min_z),
        _mm_max_pd(a.max_xy, b.max_xy), _mm_max_pd(a.max_z, b.max_z)};
}

static inline struct limits merge_children(const struct node *node) {
    return merge(load(&node->children[0]->aabb), load(&node->children[1]->aabb));
}

/* Twice the distances between the centres of two AABBs along each axis. */
static inline void distances(struct limits a, struct limits b, __m128d *xy, __m128d *z) {
    const __m128d sign = _mm_set1_pd(-0.0);
    *xy = _mm_andnot_pd(sign, _mm_sub_pd(_mm_add_pd(a.min_xy, a.max_xy),
                                         _mm_add_pd(b.min_xy, b.max_xy)));
    *z = _mm_andnot_pd(sign, _mm_sub_pd(_mm_add_pd(a.min_z, a.max_z),
                                        _mm_add_pd(b.min_z, b.max_z)));
}

/* The child whose centre is closer to that of an AABB. */
static inline struct node *closer_child(const struct node *node, struct limits aabb) {
    __m128d xy[2], z[2];
    for (int i = 0; i < 2; i++)
        distances(aabb, load(&node->children[i]->aabb), &xy[i], &z[i]);
    const __m128d sums = _mm_add_pd(
        _mm_add_pd(_mm_unpacklo_pd(xy[0], xy[1]), _mm_unpackhi_pd(xy[0], xy[1])),
        _mm_unpacklo_pd(z[0], z[1]));
    const int is_first = _mm_comilt_sd(sums, _mm_unpackhi_pd(sums, sums));
    /* A jump, which the hint brings about, is faster than a computed index: the processor
       predicts most of these jumps and loads the next node earlier. */
    if (__builtin_expect(is_first, 1)) return node->children[0];
    return node->children[1];
}

/* Puts a node in the place of another one. */
static inline void replace_child(struct aabb_tree *tree, struct node *parent,
                                 const struct node *old, struct node *new) {
    new->parent = parent;
    if (parent == NULL)
        tree->root = new;
    else
        parent->children[parent->children[1] == old] = new;
}

/* Removes a leaf from the tree, changes its AABB, and inserts it again. The tree must
   have another leaf. */
static void move_leaf(struct aabb_tree *tree, struct node *leaf, struct limits aabb) {
    /* The parent of the leaf leaves the tree, too, and becomes its new parent. It must be
       this node again, because Bullet compares the addresses of nodes when it optimises
       the tree. */
    struct node *parent = leaf->parent, *above = parent->parent;
    struct node *sibling = parent->children[parent->children[0] == leaf];
    replace_child(tree, above, parent, sibling);
    for (; above != NULL; above = above->parent) {
        const struct limits shrunk = merge_children(above);
        if (is_same(shrunk, load(&above->aabb))) break;
        save(&above->aabb, shrunk);
    }

    sibling = tree->root;
    while (sibling->children[1] != NULL) sibling = closer_child(sibling, aabb);
    above = sibling->parent;
    replace_child(tree, above, sibling, parent);
    parent->children[0] = sibling;
    parent->children[1] = leaf;
    sibling->parent = leaf->parent = parent;
    struct limits grown = merge(aabb, load(&sibling->aabb));
    save(&leaf->aabb, aabb);
    save(&parent->aabb, grown);
    for (; above != NULL && !contains(load(&above->aabb), grown); above = above->parent) {
        grown = merge_children(above);
        save(&above->aabb, grown);
    }
}

static void set_limits(struct aabbs *aabbs, int index, const struct aabb *aabb) {
    const double limits[] = {aabb->min.x, aabb->min.y, aabb->min.z,
                             aabb->max.x, aabb->max.y, aabb->max.z};
    for (int i = 0; i < 6; i++) aabbs->limits[i][index] = limits[i];
}

/* Objects whose AABBs overlap an AABB: bit i stands for object i. */
static uint64_t find_overlaps(const struct aabbs *aabbs, const struct aabb *aabb) {
    const double mins[] = {aabb->min.x, aabb->min.y, aabb->min.z};
    const double maxs[] = {aabb->max.x, aabb->max.y, aabb->max.z};
    uint64_t overlaps = 0;
    for (int i = 0; i < aabbs->num_objects; i += 2) {
        __m128d both = _mm_cmpeq_pd(_mm_setzero_pd(), _mm_setzero_pd());
        for (int axis = 0; axis < 3; axis++) {
            const __m128d min = _mm_load_pd(&aabbs->limits[axis][i]);
            const __m128d max = _mm_load_pd(&aabbs->limits[3 + axis][i]);
            both = _mm_and_pd(both, _mm_cmple_pd(min, _mm_set1_pd(maxs[axis])));
            both = _mm_and_pd(both, _mm_cmpge_pd(max, _mm_set1_pd(mins[axis])));
        }
        overlaps |= (uint64_t)_mm_movemask_pd(both) << i;
    }
    return overlaps;
}

/* Reads the AABBs of all objects, and all known pairs. Returns 0 if a limit is NaN, or if
   the objects are not those of the broad phase. */
static int read_aabbs(struct aabbs *aabbs, const struct broad_phase *broad_phase) {
    const struct array *objects = &aabbs->world->objects;
    const struct array *pairs = &broad_phase->pair_cache->pairs;
    const struct aabb_tree *trees = broad_phase->trees;
    if (trees[0].num_leaves + trees[1].num_leaves != objects->size) return 0;
    for (int i = 0; i < objects->size; i++) {
        const struct collision_object *object =
            ((struct collision_object *const *)objects->data)[i];
        if (object->world_index != i) return 0;
        const struct limits limits = load(&object->proxy->leaf->aabb);
        if (!overlap(limits, limits)) return 0;
        set_limits(aabbs, i, &object->proxy->leaf->aabb);
        aabbs->pairs[i] = (uint64_t)1 << i;
    }
    /* find_overlaps compares two objects at once. If the last object has no partner, it
       gets one that overlaps nothing. */
    if (objects->size % 2) aabbs->limits[0][objects->size] = INFINITY;
    for (int i = 0; i < pairs->size; i++) {
        const struct overlapping_pair *pair =
            (const struct overlapping_pair *)pairs->data + i;
        const int a = pair->a->object->world_index, b = pair->b->object->world_index;
        if (a < 0 || a >= objects->size || b < 0 || b >= objects->size) return 0;
        aabbs->pairs[a] |= (uint64_t)1 << b;
        aabbs->pairs[b] |= (uint64_t)1 << a;
    }
    aabbs->num_objects = objects->size;
    aabbs->num_pairs = pairs->size;
    return 1;
}

int move_aabb(struct aabbs *aabbs, struct broad_phase *broad_phase, struct proxy *proxy,
              const struct vector3 *min, const struct vector3 *max) {
    struct aabb_tree *tree = &broad_phase->trees[0];
    struct node *leaf = proxy->leaf;
    const struct aabb moved = {*min, *max};
    const struct limits new = load(&moved), old = load(&leaf->aabb);
    if (proxy->stage == FIXED_STAGE || tree->root == leaf || tree->free != NULL ||
        tree->lookahead >= 0 || broad_phase->prediction != 0.0 ||
        broad_phase->defers_collisions || !overlap(old, new))
        return 0;
    if (!contains(old, new)) {
        if (aabbs->num_objects == 0 && !read_aabbs(aabbs, broad_phase)) return 0;
        const int index = proxy->object->world_index;
        if (index < 0 || index >= aabbs->num_objects) return 0;
        uint64_t overlaps = find_overlaps(aabbs, &moved);
        if (overlaps & ~aabbs->pairs[index]) return 0;
        move_leaf(tree, leaf, new);
        set_limits(aabbs, index, &moved);
        broad_phase->needs_cleanup = 1;
        broad_phase->num_updates++;
        /* Bullet counts known pairs as new. One bit of `overlaps` belongs to the moved
           object itself. This bit is not a pair, so the loop counts the other bits. */
        while (overlaps &= overlaps - 1) broad_phase->num_new_pairs++;
    }
    broad_phase->num_calls++;

    /* The link goes from its list to the head of the list of the present stage. */
    struct proxy **stages = broad_phase->stages;
    if (proxy->previous != NULL)
        proxy->previous->next = proxy->next;
    else
        stages[proxy->stage] = proxy->next;
    if (proxy->next != NULL) proxy->next->previous = proxy->previous;
    const int stage = broad_phase->stage;
    proxy->aabb = moved;
    proxy->stage = stage;
    proxy->previous = NULL;
    proxy->next = stages[stage];
    if (proxy->next != NULL) proxy->next->previous = proxy;
    stages[stage] = proxy;
    aabbs->num_moved++;
    return 1;
}

void follow_bullet(struct aabbs *aabbs, const struct broad_phase *broad_phase,
                   const struct proxy *proxy) {
    const struct aabb *aabb = &proxy->leaf->aabb;
    const struct limits limits = load(aabb);
    const int index = proxy->object->world_index;
    if (broad_phase->pair_cache->pairs.size != aabbs->num_pairs ||
        !overlap(limits, limits) || index < 0 || index >= aabbs->num_objects)
        aabbs->num_objects = 0; /* read again */
    else
        set_limits(aabbs, index, aabb);
    aabbs->num_left++;
}
#endif
