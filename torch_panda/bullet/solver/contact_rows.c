/*
 * Rows of contacts, with friction and spinning friction.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * convert_manifold  btMultiBodyConstraintSolver::convertMultiBodyContact
 * finish_contact    btMultiBodyConstraintSolver::setupMultiBodyContactConstraint, and
 *                   addMultiBodyFrictionConstraint for friction
 * finish_spinning   btMultiBodyConstraintSolver::
 *                   setupMultiBodyTorsionalFrictionConstraint
 * fill_jacobians    btMultiBody::fillConstraintJacobianMultiDof
 * respond           btMultiBody::calcAccelerationDeltasMultiDof, for a body without links
 * set_directions    btPlaneSpace1 and btVector3::normalize
 *
 * Why the results are the same bits
 * ---------------------------------
 * Bullet creates the rows of a contact one after the other. For every row, it transforms
 * the contact into the frame of each link again. Here, one transformation serves all
 * rows of a contact, and a body without links skips the loops over links. All other
 * operations are Bullet's, in Bullet's order. For bodies with links, see responses.c.
 *
 * Bullet's function creates the rows of a manifold if find_side refuses a body, if there
 * is rolling or anisotropic friction, or if a number is not finite.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"
#include "vectors.h"

#include <math.h>

static inline double dot(const struct vector3 *a, const struct vector3 *b) {
    return a->x * b->x + a->y * b->y + a->z * b->z;
}

static inline struct vector3 minus(const struct vector3 *a, const struct vector3 *b) {
    return (struct vector3){a->x - b->x, a->y - b->y, a->z - b->z, 0.0};
}

static inline struct vector3 negative(const struct vector3 *a) {
    return (struct vector3){-a->x, -a->y, -a->z, 0.0};
}

static inline struct vector3 rotate(const struct matrix3 *m, const struct vector3 *a) {
    return (struct vector3){dot(&m->row[0], a), dot(&m->row[1], a), dot(&m->row[2], a),
                            0.0};
}

static inline struct vector3 rotate_back(const struct matrix3 *m,
                                         const struct vector3 *a) {
    const struct vector3 *r = m->row;
    return (struct vector3){r[0].x * a->x + r[1].x * a->y + r[2].x * a->z,
                            r[0].y * a->x + r[1].y * a->y + r[2].y * a->z,
                            r[0].z * a->x + r[1].z * a->y + r[2].z * a->z, 0.0};
}

static void set_directions(const struct vector3 *n, struct vector3 *p,
                           struct vector3 *q) {
    if (fabs(n->z) > 0.7071067811865475244008443621048490) { /* SIMDSQRT12 */
        const double a = n->y * n->y + n->z * n->z, k = 1.0 / sqrt(a);
        p->x = 0.0;
        p->y = -n->z * k;
        p->z = n->y * k;
        q->x = a * k;
        q->y = -n->x * p->z;
        q->z = n->x * p->y;
    } else {
        const double a = n->x * n->x + n->y * n->y, k = 1.0 / sqrt(a);
        p->x = -n->y * k;
        p->y = n->x * k;
        p->z = 0.0;
        q->x = -n->z * p->y;
        q->y = n->z * p->x;
        q->z = a * k;
    }
    struct vector3 *const both[] = {p, q};
    for (int i = 0; i < 2; i++) {
        struct vector3 *direction = both[i];
        const double scale = 1.0 / sqrt(dot(direction, direction));
        direction->x *= scale;
        direction->y *= scale;
        direction->z *= scale;
    }
}

static int is_static(const struct multi_body *body) {
    return body->fixed_base || (body->base_collider != NULL &&
                                body->base_collider->flags & (STATIC | KINEMATIC));
}

/* Computes the change of velocity of a body by a unit impulse along a Jacobian. */
static void respond(const struct multi_body *body, const double *jacobian,
                    double *unit) {
    const struct matrix3 *rotation = body->matrix_buffer.data;
    struct vector3 angular = {0.0, 0.0, 0.0, 0.0}, linear = {0.0, 0.0, 0.0, 0.0};
    if (!is_static(body)) {
        const struct vector3 torque = {-jacobian[0], -jacobian[1], -jacobian[2], 0.0};
        const struct vector3 force = {-jacobian[3], -jacobian[4], -jacobian[5], 0.0};
        const struct vector3 local_force = rotate(rotation, &force);
        const struct vector3 local_torque = rotate(rotation, &torque);
        const struct vector3 *inertia = &body->base_inertia;
        if (inertia->x >= EPSILON && inertia->y >= EPSILON && inertia->z >= EPSILON)
            angular = (struct vector3){local_torque.x / inertia->x,
                                       local_torque.y / inertia->y,
                                       local_torque.z / inertia->z, 0.0};
        if (body->base_mass >= EPSILON) {
            const double scale = 1.0 / body->base_mass;
            linear = (struct vector3){local_force.x * scale, local_force.y * scale,
                                      local_force.z * scale, 0.0};
        }
        angular = negative(&angular);
        linear = negative(&linear);
    }
    const struct vector3 world_angular = rotate_back(rotation, &angular);
    const struct vector3 world_linear = rotate_back(rotation, &linear);
    unit[0] = world_angular.x;
    unit[1] = world_angular.y;
    unit[2] = world_angular.z;
    unit[3] = world_linear.x;
    unit[4] = world_linear.y;
    unit[5] = world_linear.z;
}

static const struct vector3 ZERO = {0.0, 0.0, 0.0, 0.0};

/* A row of a contact while it is created: its directions and its parts, by body. */
struct direction {
    struct vector3 angular[2], linear[2];
    double *jacobian[2], *unit[2];
    struct constraint_row *row;
};

enum { MAX_ROWS = 4 }; /* of a contact: normal, spinning and two of friction */

/* A body at a contact. */
struct side {
    struct multi_body *body;
    int link;
    const struct responses *responses; /* NULL for a body without joints */
    const struct vector3 *position;
};

/* Fills the Jacobians of all rows of a contact, for one of its bodies. */
static void fill_jacobians(const struct side *side, struct direction *rows,
                           int num_rows, int part) {
    const struct multi_body *body = side->body;
    const struct vector3 arm = minus(side->position, &body->base_position);
    for (int i = 0; i < num_rows; i++) {
        const struct vector3 *angular = &rows[i].angular[part];
        const struct vector3 *linear = &rows[i].linear[part];
        const struct vector3 turn = cross(&arm, linear);
        double *jacobian = rows[i].jacobian[part];
        jacobian[0] = turn.x + angular->x;
        jacobian[1] = turn.y + angular->y;
        jacobian[2] = turn.z + angular->z;
        jacobian[3] = linear->x;
        jacobian[4] = linear->y;
        jacobian[5] = linear->z;
    }
    if (side->link < 0) return;

    const struct link *links = body->links.data;
    int chain[MAX_LINKS], length = 0; /* from the link to the base */
    for (int i = side->link; i >= 0; i = links[i].parent) chain[length++] = i;
    struct matrix3 rotation = rotation_matrix(&body->base_rotation);
    struct vector3 local = rotate(&rotation, &arm);
    struct vector3 angular[MAX_ROWS], linear[MAX_ROWS];
    for (int i = 0; i < num_rows; i++) {
        angular[i] = rotate(&rotation, &rows[i].angular[part]);
        linear[i] = rotate(&rotation, &rows[i].linear[part]);
    }
    for (int k = length - 1; k >= 0; k--) {
        const struct link *link = &links[chain[k]];
        const struct vector3 *top = &link->axes[0].top, *bottom = &link->axes[0].bottom;
        rotation = rotation_matrix(&link->rotation);
        const struct vector3 turned = rotate(&rotation, &local);
        local = minus(&turned, &link->r_vector);
        struct vector3 lever = cross(top, &local);
        lever = (struct vector3){lever.x + bottom->x, lever.y + bottom->y,
                                 lever.z + bottom->z, 0.0};
        for (int i = 0; i < num_rows; i++) {
            angular[i] = rotate(&rotation, &angular[i]);
            linear[i] = rotate(&rotation, &linear[i]);
            if (!link->num_dofs) continue;
            double *entry = &rows[i].jacobian[part][6 + link->dof_offset];
            *entry = link->joint_type == REVOLUTE
                         ? dot(&linear[i], &lever) + dot(&angular[i], top)
                         : dot(&linear[i], bottom);
        }
    }
}

/* Fills the unit responses of all rows of a contact, for one of its bodies. */
static void fill_responses(const struct side *side, struct direction *rows,
                           int num_rows, int part) {
    if (side->responses == NULL) {
        for (int i = 0; i < num_rows; i++)
            respond(side->body, rows[i].jacobian[part], rows[i].unit[part]);
        return;
    }
    if (side->link < 0) return; /* the base is fixed: nothing responds */
    double unused[MAX_LINKS];
    for (int i = 0; i < num_rows; i += 2) {
        const int has_second = i + 1 < num_rows;
        const double *const impulses[2] = {
            rows[i].jacobian[part] + 6,
            has_second ? rows[i + 1].jacobian[part] + 6 : rows[i].jacobian[part] + 6};
        double *const results[2] = {rows[i].unit[part] + 6,
                                    has_second ? rows[i + 1].unit[part] + 6 : unused};
        solve_pair(side->responses, impulses, results);
    }
}

static double product(const double *a, const double *b, int count) {
    double sum = 0.0;
    for (int i = 0; i < count; i++) sum += a[i] * b[i];
    return sum;
}

/* Fills the fields that contact, friction and spinning rows share. Returns the velocity
   along the row. */
static double finish_row(const struct side *sides, const struct direction *direction,
                         double cfm, const struct solver_info *info) {
    struct constraint_row *row = direction->row;
    const int size_a = sides[0].body->num_dofs + 6, size_b = sides[1].body->num_dofs + 6;
    const double *const *jacobian = (const double *const *)direction->jacobian;
    const double denominator_a = product(jacobian[0], direction->unit[0], size_a);
    const double denominator_b = product(jacobian[1], direction->unit[1], size_b);
    const double d = denominator_a + denominator_b + cfm;
    row->jac_diag_inv = d > EPSILON ? info->relaxation / d : 0.0;
    row->applied_impulse = 0.0;
    row->applied_push_impulse = 0.0;
    row->rhs_penetration = 0.0;
    const double *velocity_a = sides[0].body->real_buffer.data;
    const double *velocity_b = sides[1].body->real_buffer.data;
    double velocity = 0.0;
    for (int i = 0; i < size_a; i++) velocity += velocity_a[i] * jacobian[0][i];
    for (int i = 0; i < size_b; i++) velocity += velocity_b[i] * jacobian[1][i];
    return velocity;
}

/* Vector from the link's centre of mass to the contact. */
static struct vector3 link_arm(const struct side *side) {
    const struct link *links = side->body->links.data;
    return minus(side->position, side->link < 0 ? &side->body->base_position
                                                : &links[side->link].world_origin);
}

static void finish_contact(const struct side *sides, const struct direction *direction,
                           const struct contact_point *point, int is_friction,
                           const struct solver_info *info) {
    struct constraint_row *row = direction->row;
    const double inverse_time_step = 1.0 / info->time_step;
    double cfm = is_friction ? info->friction_cfm : info->cfm;
    double erp = is_friction ? info->friction_erp : info->erp2;
    if (!is_friction && point->flags & (HAS_CFM | HAS_ERP)) {
        if (point->flags & HAS_CFM) cfm = point->cfm_or_stiffness;
        if (point->flags & HAS_ERP) erp = point->erp_or_damping;
    } else if (!is_friction && point->flags & HAS_STIFFNESS_AND_DAMPING) {
        double denominator =
            info->time_step * point->cfm_or_stiffness + point->erp_or_damping;
        if (denominator < EPSILON) denominator = EPSILON;
        cfm = 1.0 / denominator;
        erp = info->time_step * point->cfm_or_stiffness / denominator;
    }
    cfm *= inverse_time_step;
    const double velocity = finish_row(sides, direction, cfm, info);
    const struct vector3 *normal = &direction->linear[0];
    const struct vector3 arm_a = link_arm(&sides[0]), arm_b = link_arm(&sides[1]);
    const struct vector3 turn_b = cross(&arm_b, normal);
    row->relpos1_cross_normal = cross(&arm_a, normal);
    row->contact_normal1 = *normal;
    row->relpos2_cross_normal = negative(&turn_b);
    row->contact_normal2 = direction->linear[1];
    row->friction = point->friction;

    double velocity_error, position_error;
    if (is_friction) {
        double distance = 0.0;
        if (point->flags & FRICTION_ANCHOR) {
            const struct vector3 gap = minus(&point->position_a, &point->position_b);
            distance = dot(&gap, normal);
        }
        velocity_error = 0.0 - velocity;
        position_error = -distance * erp / info->time_step;
        row->lower_limit = -row->friction;
        row->upper_limit = row->friction;
    } else {
        double restitution = fabs(velocity) < info->restitution_threshold
                                 ? 0.0
                                 : point->restitution * -velocity;
        if (restitution <= 0.0) restitution = 0.0;
        velocity_error = restitution - velocity;
        const double distance = point->distance + info->linear_slop;
        if (distance > 0.0) {
            position_error = 0.0;
            velocity_error -= distance / info->time_step;
        } else {
            position_error = -distance * erp / info->time_step;
        }
        row->lower_limit = 0.0;
        row->upper_limit = 1e10f;
    }
    row->rhs = position_error * row->jac_diag_inv + velocity_error * row->jac_diag_inv;
    row->cfm = cfm * row->jac_diag_inv;
}

static void finish_spinning(const struct side *sides, const struct direction *direction,
                            const struct contact_point *point,
                            const struct solver_info *info) {
    struct constraint_row *row = direction->row;
    const double velocity = finish_row(sides, direction, info->cfm, info);
    row->relpos1_cross_normal = direction->angular[0];
    row->contact_normal1 = ZERO;
    row->relpos2_cross_normal = direction->angular[1];
    row->contact_normal2 = negative(&ZERO);
    row->friction = point->spinning_friction;
    row->rhs = (0.0 - velocity) * row->jac_diag_inv;
    row->lower_limit = -row->friction;
    row->upper_limit = row->friction;
    row->cfm = info->cfm * row->jac_diag_inv;
}

/* Appends a row to one of the solver's arrays, with room for both bodies' parts. */
static void begin_row(struct solver *solver, struct array *rows, int friction_index,
                      const struct side *sides, struct contact_point *point,
                      struct direction *direction) {
    struct jacobian_data *data = &solver->data;
    struct constraint_row *row = direction->row = expand(rows);
    row->constraint = NULL;
    row->constraint_row = -1;
    row->solver_body_a = row->solver_body_b = -1;
    row->multi_body_a = sides[0].body;
    row->multi_body_b = sides[1].body;
    row->link_a = sides[0].link;
    row->link_b = sides[1].link;
    row->contact_point = point;
    row->friction_index = friction_index;
    int *const velocities[2] = {&row->delta_vel_a, &row->delta_vel_b};
    int *const jacobians[2] = {&row->jac_a, &row->jac_b};
    for (int part = 0; part < 2; part++) {
        const int size = sides[part].body->num_dofs + 6;
        *velocities[part] = velocity_index(sides[part].body, data);
        *jacobians[part] = data->jacobians.size;
        direction->jacobian[part] = append(&data->jacobians, size);
        direction->unit[part] = append(&data->unit_impulses, size);
    }
}

/* ---- a manifold ---------------------------------------------------------------- */

static int find_side(struct responses **responses, const struct link_collider *collider,
                     struct side *side) {
    if (!(collider->base.internal_type & LINK_COLLIDER) ||
        collider->base.has_anisotropic_friction)
        return 0;
    side->body = collider->body;
    side->link = collider->link;
    const struct multi_body *body = collider->body;
    if (body->num_dofs == 0) {
        side->responses = NULL;
        return body->links.size == 0 && side->link == -1 &&
               body->matrix_buffer.size == 1 && body->real_buffer.size >= 6 &&
               finite_zero(body->matrix_buffer.data, 12) +
                       finite_zero(body->real_buffer.data, 6) +
                       finite_zero(&body->base_position.x, 3) ==
                   0.0;
    }
    side->responses = get_responses(responses, body);
    if (side->responses == NULL || side->link < -1 || side->link >= body->links.size ||
        finite_zero(&body->base_position.x, 3) + finite_zero(&body->base_rotation.x, 4) !=
            0.0)
        return 0;
    const struct link *link = body->links.data;
    for (int i = 0; i < body->links.size; i++, link++)
        if (link->num_dofs && link->joint_type != REVOLUTE &&
            link->joint_type != PRISMATIC)
            return 0;
    return 1;
}

static int is_simple_point(const struct contact_point *point) {
    const int known = LATERAL_FRICTION_INITIALIZED | HAS_CFM | HAS_ERP |
                      HAS_STIFFNESS_AND_DAMPING | FRICTION_ANCHOR;
    return !(point->flags & ~known) && !(point->rolling_friction > 0.0) &&
           finite_zero(&point->position_b.x, 3) + finite_zero(&point->position_a.x, 3) +
                   finite_zero(&point->normal_b.x, 3) +
                   finite_zero(&point->distance, 5) +
                   finite_zero(&point->cfm_or_stiffness, 2) ==
               0.0;
}

/* Creates the rows of a contact; returns 0 if a number is not finite. */
static int convert_point(struct solver *solver, struct side *sides,
                         struct contact_point *point, const struct solver_info *info) {
    struct direction directions[MAX_ROWS];
    int num_rows = 0;
    const int normal_index = solver->multi_body_normal_rows.size;
    const int friction_index = solver->multi_body_friction_rows.size;
    const struct vector3 *normal = &point->normal_b;
    sides[0].position = &point->position_a;
    sides[1].position = &point->position_b;
    set_directions(normal, &point->lateral_1, &point->lateral_2);

    struct direction *next = directions;
    *next = (struct direction){{ZERO, ZERO}, {*normal, negative(normal)}, {0}, {0}, NULL};
    begin_row(solver, &solver->multi_body_normal_rows, friction_index, sides, point,
              next++);
    const int is_spinning = point->spinning_friction > 0.0;
    if (is_spinning) {
        *next =
            (struct direction){{*normal, negative(normal)}, {ZERO, ZERO}, {0}, {0}, NULL};
        begin_row(solver, &solver->multi_body_spinning_rows, normal_index, sides, point,
                  next++);
    }
    const int num_directions = info->mode & TWO_FRICTION_DIRECTIONS ? 2 : 1;
    for (int i = 0; i < num_directions; i++) {
        const struct vector3 *lateral = i ? &point->lateral_2 : &point->lateral_1;
        *next = (struct direction){
            {ZERO, ZERO}, {*lateral, negative(lateral)}, {0}, {0}, NULL};
        begin_row(solver, &solver->multi_body_friction_rows, normal_index, sides, point,
                  next++);
    }
    num_rows = (int)(next - directions);

    double zero = 0.0;
    for (int part = 0; part < 2; part++) {
        fill_jacobians(&sides[part], directions, num_rows, part);
        fill_responses(&sides[part], directions, num_rows, part);
        const int size = sides[part].body->num_dofs + 6;
        for (int i = 0; i < num_rows; i++)
            zero += finite_zero(directions[i].jacobian[part], size) +
                    finite_zero(directions[i].unit[part], size);
    }
    if (zero != 0.0) return 0;
    for (int i = 0; i < num_rows; i++) {
        if (is_spinning && i == 1)
            finish_spinning(sides, &directions[i], point, info);
        else
            finish_contact(sides, &directions[i], point, i > 0, info);
    }
    if (num_directions == 2 && info->mode & FIXED_FRICTION_DIRECTIONS)
        point->flags |= LATERAL_FRICTION_INITIALIZED;
    return 1;
}

int convert_manifold(struct responses **responses, struct solver *solver,
                     struct manifold *manifold, const struct solver_info *info) {
    struct side sides[2];
    if (info->mode & (CACHED_FRICTION_DIRECTIONS | ARTICULATED_WARMSTARTING)) return 0;
    const int num_points = manifold->num_points;
    const int num_directions = info->mode & TWO_FRICTION_DIRECTIONS ? 2 : 1;
    int num_normal = 0, num_spinning = 0;
    for (int i = 0; i < num_points; i++) {
        const struct contact_point *point = &manifold->points[i];
        if (!is_simple_point(point)) return 0;
        if (!(point->distance <= manifold->processing_threshold)) continue;
        num_normal++;
        num_spinning += point->spinning_friction > 0.0;
    }
    if (num_normal && (!find_side(responses, manifold->body_a, &sides[0]) ||
                       !find_side(responses, manifold->body_b, &sides[1])))
        return 0;
    struct jacobian_data *data = &solver->data;
    struct array *const arrays[] = {&solver->multi_body_normal_rows,
                                    &solver->multi_body_spinning_rows,
                                    &solver->multi_body_friction_rows,
                                    &data->jacobians,
                                    &data->unit_impulses,
                                    &data->delta_velocities};
    const int num_friction = num_normal * num_directions;
    const int size =
        num_normal ? sides[0].body->num_dofs + sides[1].body->num_dofs + 12 : 0;
    const int num_entries = size * (num_normal + num_spinning + num_friction);
    int num_velocities = 0; /* of bodies that no earlier row has */
    for (int part = 0; num_normal && part < 2; part++)
        if (sides[part].body->companion_id < 0)
            num_velocities += sides[part].body->num_dofs + 6;
    const int needed[] = {num_normal,  num_spinning, num_friction,
                          num_entries, num_entries,  num_velocities};
    int before[6];
    for (int i = 0; i < 6; i++) {
        if (!has_room(arrays[i], needed[i])) return 0;
        before[i] = arrays[i]->size;
    }
    if (data->jacobians.size != data->unit_impulses.size) return 0;
    int companions[2] = {0, 0};
    for (int part = 0; num_normal && part < 2; part++)
        companions[part] = sides[part].body->companion_id;

    for (int i = 0; i < num_points; i++) {
        struct contact_point *point = &manifold->points[i];
        if (!(point->distance <= manifold->processing_threshold)) {
            point->impulse = 0.0;
            point->previous_rhs = 0.0;
        } else if (!convert_point(solver, sides, point, info)) {
            /* Remove the rows again, so that Bullet creates all rows of the manifold. */
            for (int k = 0; k < 6; k++) arrays[k]->size = before[k];
            for (int part = 0; part < 2; part++)
                sides[part].body->companion_id = companions[part];
            return 0;
        }
    }
    return 1;
}
#endif
